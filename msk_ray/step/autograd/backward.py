"""The interface of every way to differentiate an env step.

Axes: W worlds. `nq, nv, na, nu` as in MuJoCo.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from msk_ray.step.autograd.jacobian import rows_of, state_size, unit_cotangents
from msk_ray.step.autograd.tangent import Tangent
from msk_ray.step.forward import WorldBatch


class StepState(NamedTuple):
    """The state before or after an env step."""

    qpos: Tensor
    """Generalised positions [m, rad, unit quaternions], shape (W, nq)."""
    qvel: Tensor
    """Generalised velocities [m/s, rad/s], shape (W, nv)."""
    act: Tensor
    """Actuator activations, shape (W, na)."""


class Applied(NamedTuple):
    """Forces from outside the model, held over the substeps of an env step."""

    qfrc: Tensor
    """Forces on degrees of freedom [N, N m], shape (W, nv)."""
    xfrc: Tensor
    """Force [N] and torque [N m] on every body at its centre of mass, in world coordinates, shape (W, nbody, 6)."""


class InputGradients(NamedTuple):
    """Gradients with respect to the inputs of an env step; None where none was requested."""

    ctrl: Tensor | None
    """Shape (W, nu)."""
    qpos: Tensor | None
    """In raw coordinates, shape (W, nq): for a quaternion q with tangent gradient g, 2 q⊗[0, g] / |q|²."""
    qvel: Tensor | None
    """Shape (W, nv)."""
    act: Tensor | None
    """Shape (W, na)."""
    qfrc_applied: Tensor | None = None
    """Shape (W, nv)."""
    xfrc_applied: Tensor | None = None
    """Shape (W, nbody, 6)."""
    parameters: Tensor | None = None
    """Those of parameters of the model side by side, in the order in which they were asked for, shape (W, N)."""

    @classmethod
    def of(cls, found: Mapping[str, Tensor | None], parameters: Tensor | None = None) -> Self:
        """Those of inputs by name; one that is missing is None."""
        return cls(
            found.get("ctrl"),
            found.get("qpos"),
            found.get("qvel"),
            found.get("act"),
            found.get("qfrc_applied"),
            found.get("xfrc_applied"),
            parameters,
        )


class Needs(NamedTuple):
    """The inputs for which a gradient is needed."""

    ctrl: bool
    qpos: bool
    qvel: bool
    act: bool
    qfrc_applied: bool = False
    xfrc_applied: bool = False
    parameters: tuple[str, ...] = ()
    """Names of parameters of the model."""


INPUTS = ("ctrl", "qpos", "qvel", "act", "qfrc_applied", "xfrc_applied")
"""What a step is differentiated with respect to besides parameters, in the order of `InputGradients` and `Needs`."""


class Backward(ABC):
    """One way to differentiate an env step: records what it needs of the forward pass, then pulls cotangents back.

    A Simulation calls `attach` once, replays `launch_step` for every forward pass, calls `record` right after it if a
    gradient will be needed, and `vjp` once for each recorded step, latest first; `jacobian` instead where the whole
    Jacobian is wanted.
    """

    name: str
    covers_applied: ClassVar[bool] = False
    """Whether it differentiates steps under applied forces, which `record` then gets."""
    covers_parameters: ClassVar[bool] = False
    """Whether `vjp` gives gradients of parameters of the model; their recorded values are in the model by then."""

    @abstractmethod
    def attach(self, batch: WorldBatch) -> None:
        """Check that the model is supported and allocate buffers for it.

        Raises:
            UnsupportedModelError: the model has a feature that this mode cannot differentiate.
        """

    def fresh(self) -> Self:
        """A mode with the same settings, to attach to another batch. `attach` must set everything but the settings."""
        return copy.copy(self)

    def launch_step(self, batch: WorldBatch) -> None:
        """Launch one env step. A mode that keeps per-substep data overrides this; it is captured as a graph.

        It begins with `batch.begin_step()` and ends with `batch.end_step(data)`.
        """
        batch.launch_step()

    def last_data(self, batch: WorldBatch) -> Any:
        """The mujoco_warp.Data in which the last substep of an env step was computed."""
        return batch.data

    @abstractmethod
    def record(
        self, ctrl: Tensor, start: StepState, end: StepState, applied: Applied | None = None
    ) -> tuple[Tensor, ...]:
        """Tensors of the last step that `vjp` will need. They must not alias buffers that the next step overwrites.

        `applied` is only given where there are applied forces.
        """

    @abstractmethod
    def vjp(self, saved: tuple[Tensor, ...], cotangent: StepState, needs: Needs) -> InputGradients:
        """Vector-Jacobian product of the recorded step: cotangents of its results, in raw coordinates, pulled back."""

    def jacobian(
        self, saved: tuple[Tensor, ...], start: StepState, end: StepState, tangent: Tangent
    ) -> tuple[Tensor, Tensor]:
        """(A, B) of the recorded step in tangent space, shapes (W, S, S) and (W, S, nu) with S = 2 nv + na.

        This one takes a `vjp` for each row; a mode that knows a faster way overrides it.

        Args:
            saved: what `record` returned for the step.
            start, end: the states before and after it.
            tangent: the joints of the model.
        """
        needs = Needs(ctrl=True, qpos=True, qvel=True, act=True)
        rows = []
        for row in range(state_size(end)):
            cotangents = unit_cotangents(tangent, end, range(row, row + 1), 1)
            found = self.vjp(saved, StepState(*(part[0] for part in cotangents)), needs)
            rows.append(rows_of(tangent, start, found))
        return torch.stack([a for a, _ in rows], dim=1), torch.stack([b for _, b in rows], dim=1)

    def forget(self) -> None:  # noqa: B027 - a mode that gathers nothing has nothing to forget
        """Forget what diagnostics were gathered."""

    def diagnostics(self) -> dict[str, float]:
        """Diagnostics gathered since the last call, by metric name."""
        return {}
