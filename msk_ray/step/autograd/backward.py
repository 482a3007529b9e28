"""The interface of every way to differentiate an env step.

Axes: W worlds. `nq, nv, na, nu` as in MuJoCo.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
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


class ExternalForces(NamedTuple):
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
    """Gradients of model parameters, concatenated in the order requested, shape (W, N)."""

    @classmethod
    def of(cls, gradients: Mapping[str, Tensor | None], parameters: Tensor | None = None) -> Self:
        """From gradients by input name; missing ones are None."""
        return cls(
            gradients.get("ctrl"),
            gradients.get("qpos"),
            gradients.get("qvel"),
            gradients.get("act"),
            gradients.get("qfrc_applied"),
            gradients.get("xfrc_applied"),
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
    """Names of model parameters."""


INPUTS = ("ctrl", "qpos", "qvel", "act", "qfrc_applied", "xfrc_applied")
"""Inputs of a step that can have gradients, besides parameters, in the order of `InputGradients` and `Needs`."""


class Backward(ABC):
    """One way to differentiate an env step: saves what it needs of the forward pass, then pulls cotangents back.

    A Simulation calls `attach` once for each batch, replays `launch_step` for every forward pass, and calls `save`
    right after it if a gradient will be needed. Then it calls `vjp` once for each saved step, latest first, or
    `jacobian` for the whole Jacobian.
    """

    name: str
    covers_applied: ClassVar[bool] = False
    """Whether it differentiates steps with applied forces, which `save` then gets."""
    covers_parameters: ClassVar[bool] = False
    """Whether `vjp` gives gradients of model parameters, whose values in the saved step are then in the model."""

    @abstractmethod
    def attach(self, batch: WorldBatch) -> None:
        """Check that the model is supported and allocate buffers for it.

        Raises:
            UnsupportedModelError: the model has a feature that this mode cannot differentiate.
        """

    def fresh(self) -> Self:
        """A mode with the same settings, to attach to another batch. Everything except settings must be set in
        `attach`."""
        return copy.copy(self)

    def launch_step(self, batch: WorldBatch) -> None:
        """Launch one env step, which is captured as a graph. A mode that stores data per substep overrides this.

        Must begin with `batch.begin_step()` and end with `batch.end_step(data)`.
        """
        batch.launch_step()

    def pullbacks(self) -> tuple[Callable[[], None], ...]:
        """What `vjp` will launch, so that its kernels are compiled together with the step's."""
        return ()

    def last_data(self, batch: WorldBatch) -> Any:
        """The mujoco_warp.Data in which the last substep of an env step was computed."""
        return batch.data

    @abstractmethod
    def save(
        self, ctrl: Tensor, start: StepState, end: StepState, applied: ExternalForces | None = None
    ) -> tuple[Tensor, ...]:
        """Tensors of the last step that `vjp` will need, not aliasing buffers that the next step overwrites.

        `applied` is None for a step without applied forces.
        """

    @abstractmethod
    def vjp(self, saved: tuple[Tensor, ...], cotangent: StepState, needs: Needs) -> InputGradients:
        """Vector-Jacobian product of the saved step: cotangents of its results, in raw coordinates, pulled back."""

    def jacobian(
        self, saved: tuple[Tensor, ...], start: StepState, end: StepState, tangent: Tangent
    ) -> tuple[Tensor, Tensor]:
        """(A, B) of the saved step in tangent space, shapes (W, S, S) and (W, S, nu) with S = 2 nv + na.

        This implementation calls `vjp` for each row; a mode with a faster way overrides it.

        Args:
            saved: what `save` returned for the step.
            start, end: the states before and after it.
            tangent: the joints of the model.
        """
        needs = Needs(ctrl=True, qpos=True, qvel=True, act=True)
        rows = []
        for row in range(state_size(end)):
            cotangents = unit_cotangents(tangent, end, range(row, row + 1), 1)
            gradients = self.vjp(saved, StepState(*(part[0] for part in cotangents)), needs)
            rows.append(rows_of(tangent, start, gradients))
        return torch.stack([a for a, _ in rows], dim=1), torch.stack([b for _, b in rows], dim=1)

    def forget(self) -> None:  # noqa: B027 - optional
        """Reset diagnostics."""

    def diagnostics(self) -> dict[str, float]:
        """Diagnostics gathered since the last call, by metric name."""
        return {}
