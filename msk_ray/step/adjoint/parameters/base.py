"""What the families of parameters that have kernels of their own share.

With λ, μ, a and â held fixed, the gradient of a parameter θ is -∂Φ/∂θ (see `step`), besides what θ does to the
integration of activations and positions.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any, ClassVar

import warp as wp

from msk_ray.step.adjoint.groups import Substep
from msk_ray.step.adjoint.step import StepAdjoint


class ParameterFamily(ABC):
    """The gradients of one family of parameters.

    Attributes:
        kinds: groups of the gradients to which it adds; their fields are named as in MjModel, without `opt.`. It is
            launched if a field of any of them is asked for.
    """

    kinds: ClassVar[tuple[Any, ...]]

    def __init__(self, adjoint: StepAdjoint, gradients: dict[Any, Any]) -> None:
        self.adjoint, self.work = adjoint, adjoint.work
        self.gradients = [gradients[kind] for kind in self.kinds]

    @classmethod
    def applies(cls, adjoint: StepAdjoint) -> bool:
        """Whether the model has anything that it differentiates."""
        return True

    def launch_first(self, at: Substep, qvel_next: wp.array) -> None:  # noqa: B027 - most have nothing to do here
        """Launch what needs the cotangents of the state after the substep, before they are pulled back."""

    @abstractmethod
    def launch(self, at: Substep) -> None:
        """Launch what is added to `gradients`; λ, μ, a - â, their fields and the cotangents of contacts are there."""


class GradientBuffer:
    """Gradients of several groups in one array with a row per world, so that one launch clears, copies or sums them.

    Attributes:
        groups: by kind; their arrays are views of columns of `rows`.
        rows: shape (W, numbers of a world).
        columns: where each field is in a row.
    """

    def __init__(self, kinds: Iterable[Any], model: Any, nworld: int) -> None:
        self.groups = {kind: kind() for kind in kinds}
        self.columns: dict[str, slice] = {}
        places = []
        width = 0
        for kind, group in self.groups.items():
            for name, field in kind.vars.items():
                section = model.opt if hasattr(model.opt, name) else model
                shape = getattr(section, name).shape[1:]
                dtype = field.type.dtype
                size = math.prod(shape) * wp.types.type_size_in_bytes(dtype) // 4
                self.columns[name] = slice(width, width + size)
                places.append((group, name, dtype, shape))
                width += size
        self.rows = wp.zeros((nworld, width), dtype=float)
        for group, name, dtype, shape in places:
            strides = [wp.types.type_size_in_bytes(dtype)]
            for length in reversed(shape[1:]):
                strides.insert(0, strides[0] * length)
            part = wp.zeros((nworld, *shape), dtype=dtype)
            if part.size:
                part = wp.array(
                    ptr=self.rows.ptr + 4 * self.columns[name].start,
                    dtype=dtype,
                    shape=(nworld, *shape),
                    strides=(4 * width, *strides[: len(shape)]),
                    device=self.rows.device,
                    copy=False,
                )
            setattr(group, name, part)

    def clear(self) -> None:
        """Launch the start of new sums."""
        self.rows.zero_()
