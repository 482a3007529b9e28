"""The stages of a step: `mujoco_warp.step` as one, or one stage after the other around a solver of this package."""

import copy
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol

import mujoco
import mujoco_warp as mjw
import warp as wp

Solver = Callable[[Any, Any], None]
"""Launches what `mujoco_warp.solve` does, on a model and its Data."""


class Kernels(NamedTuple):
    """What a step is made of: which kernels, and how many iterations of the constraint solver at most."""

    ordered: bool = False
    """Add everything up in a fixed order, so that a GPU repeats a step bit for bit; the Jacobian is dense."""
    fused_solver: bool = False
    """Solve the constraints in one launch, for small models; the Jacobian is dense."""
    iterations: int | None = None
    """Most iterations of the solver; None: the model's, but at least 100, with a warning where that is more."""
    ls_iterations: int | None = None
    """Most iterations of each of its line searches; None: the model's, but at least 50, likewise."""

    @property
    def dense(self) -> bool:
        """Whether they need a dense Jacobian."""
        return self.ordered or self.fused_solver


PACKAGE: Final = Kernels()
"""mujoco_warp's."""


class Stages(Protocol):
    """Launches of a step and of its parts."""

    ordered: bool
    """Whether they add everything up in a fixed order."""
    unrolls: bool
    """Whether a recording that joins another library's capture holds every iteration of the solver as launches."""

    def step(self, model: Any, data: Any) -> None:
        """Launch one physics step."""

    def position(self, model: Any, data: Any) -> None:
        """Launch the position stage, without a factor of the inertia."""

    def tendon(self, model: Any, data: Any) -> None:
        """Launch lengths and Jacobians of tendons."""

    def slopes(self, model: Any, data: Any, out: wp.array) -> None:
        """Launch M - h ∂τ/∂v of the implicitfast integrator, in the layout of M, into `out` (W, nC)."""

    def summing(self, model: Any) -> Any:
        """The model to give to stages of mujoco_warp that are launched one by one."""


class PackageStages:
    """mujoco_warp's."""

    ordered = False
    unrolls = True

    def step(self, model: Any, data: Any) -> None:
        """Launch `mujoco_warp.step`."""
        mjw.step(model, data)

    def position(self, model: Any, data: Any) -> None:
        """Launch `mujoco_warp.fwd_position`."""
        mjw.fwd_position(model, data, factorize=False)

    def tendon(self, model: Any, data: Any) -> None:
        """Launch `mujoco_warp.tendon`."""
        mjw.tendon(model, data)

    def slopes(self, model: Any, data: Any, out: wp.array) -> None:
        """Launch `mujoco_warp.deriv_smooth_vel`."""
        mjw.deriv_smooth_vel(model, data, out)

    def summing(self, model: Any) -> Any:
        """The model itself."""
        return model


class ComposedStages(PackageStages):
    """`mujoco_warp.step` of Euler, implicit and implicitfast, stage by stage, around another solver.

    Args:
        solve: the solver.
        unrolls: whether it launches its iterations one by one.
    """

    def __init__(self, solve: Solver, unrolls: bool) -> None:
        self._solve = solve
        self.unrolls = unrolls

    def of(self, stage: str, model: Any) -> Any:
        """The model to give to a stage: inertia, constraint, velocity, actuation, acceleration or integration."""
        return model

    def actuation(self, model: Any, data: Any) -> None:
        """Launch the forces of actuators."""
        mjw.fwd_actuation(self.of("actuation", model), data)

    def integrate(self, model: Any, data: Any) -> None:
        """Launch the step in time."""
        if model.opt.integrator == mjw.IntegratorType.EULER:
            mjw.euler(self.of("acceleration", model), data)
        else:
            mjw.implicit(self.of("integration", model), data)

    def step(self, model: Any, data: Any) -> None:
        """Launch one physics step."""
        self.position(model, data)
        data.sensordata.zero_()
        mjw.sensor_pos(model, data)
        mjw.fwd_velocity(self.of("velocity", model), data)
        mjw.sensor_vel(model, data)
        self.actuation(model, data)
        mjw.fwd_acceleration(self.of("acceleration", model), data, factorize=True)
        self._solve(model, data)
        mjw.sensor_acc(model, data)
        self.integrate(model, data)


def dense(mjm: mujoco.MjModel) -> mujoco.MjModel:
    """The model with a dense Jacobian, the only one that solvers of this package read."""
    if mjm.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE:
        return mjm
    changed = copy.copy(mjm)
    changed.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return changed


def with_options(model: Any, **options: Any) -> Any:
    """A copy of mujoco_warp's model with other options and the same arrays."""
    changed, opt = copy.copy(model), copy.copy(model.opt)
    # The seal is not for these copies, which no recorded graph reads.
    for name, value in options.items():
        object.__setattr__(opt, name, value)
    object.__setattr__(changed, "opt", opt)
    return changed
