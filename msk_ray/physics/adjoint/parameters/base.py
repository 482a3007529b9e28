"""What the stages that differentiate parameters share.

With λ, μ, a and â held fixed, the gradient of a parameter θ is -∂Φ/∂θ (see `step`), besides what θ does to the
integration of activations and positions.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import warp as wp

from msk_ray.physics.adjoint.contacts import ContactForces
from msk_ray.physics.adjoint.groups import Substep
from msk_ray.physics.adjoint.integrate import Integrator
from msk_ray.physics.adjoint.rows import ConstraintLaws
from msk_ray.physics.adjoint.workspace import Workspace

wp.set_module_options({"enable_backward": False})


@wp.func
def quat_gradient(q: wp.quat, g: wp.vec3) -> wp.vec4:
    """2 q⊗[0, g]: the raw gradient of a unit quaternion (w, x, y, z) whose slope along local rotations is g."""
    u = wp.vec3(q[1], q[2], q[3])
    r = 2.0 * (q[0] * g + wp.cross(u, g))
    return wp.vec4(-2.0 * wp.dot(u, g), r[0], r[1], r[2])


@dataclass(frozen=True)
class Parts:
    """What the launches of a substep's pullback leave for the parameters."""

    work: Workspace
    integrator: Integrator
    laws: ConstraintLaws
    contacts: ContactForces
    timestep: wp.array
    """Gradient of the time step, to which every stage whose law has one adds its part, (W,)."""


class ParameterStage(ABC):
    """The gradients of one family of parameters.

    Attributes:
        kind: group of the gradients; its fields are named as in MjModel, without `opt.`.
    """

    kind: ClassVar[Any]

    def __init__(self, parts: Parts, gradients: Any) -> None:
        self.parts, self.gradients = parts, gradients

    def launch_first(self, at: Substep, qvel_next: wp.array) -> None:  # noqa: B027 - most have nothing to do here
        """Launch what needs the cotangents of the state after the substep, before they are pulled back."""

    @abstractmethod
    def launch(self, at: Substep) -> None:
        """Launch what is added to `gradients`; λ, μ, a - â, their fields and the cotangents of contacts are there."""


class GradientBuffer:
    """Gradients of several groups in one stretch of memory, which one launch clears.

    Attributes:
        groups: by kind.
        timestep: gradient of the time step, (W,).
    """

    def __init__(self, kinds: list[Any], model: Any, nworld: int) -> None:
        spaces = []
        for kind in kinds:
            for name, field in kind.vars.items():
                section = model.opt if hasattr(model.opt, name) else model
                spaces.append((kind, name, field.type.dtype, (nworld, *getattr(section, name).shape[1:])))
        words = [math.prod(shape) * wp.types.type_size_in_bytes(dtype) // 4 for _, _, dtype, shape in spaces]
        self._floats = wp.zeros(nworld + sum(words), dtype=float)
        self.timestep = self._floats[:nworld]
        self.groups = {kind: kind() for kind in kinds}
        offset = nworld
        for (kind, name, dtype, shape), size in zip(spaces, words, strict=True):
            part = wp.zeros(shape, dtype=dtype)
            if size:
                pointer = self._floats.ptr + 4 * offset
                part = wp.array(ptr=pointer, dtype=dtype, shape=shape, device=self._floats.device, copy=False)
            setattr(self.groups[kind], name, part)
            offset += size

    def clear(self) -> None:
        """Launch the start of new sums."""
        self._floats.zero_()
