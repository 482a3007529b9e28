"""The stages of a step: `mujoco_warp.step` as a whole, or stage by stage with a solver of this package."""

import copy
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol

import mujoco
import mujoco_warp as mjw
import warp as wp

Solver = Callable[[Any, Any], None]
"""A replacement for `mujoco_warp.solve`, called with a model and its Data."""


class Kernels(NamedTuple):
    """Choice of a step's kernels, and iteration limits of its constraint solver."""

    ordered: bool = False
    """Sum in a fixed order, so that a GPU repeats a step bit for bit; needs a dense Jacobian."""
    fused_solver: bool | None = False
    """Solve constraints in one launch; needs a dense Jacobian. None: for models that are small enough, as a batch
    decides when it is made."""
    iterations: int | None = None
    """Iteration limit of the solver; None: the model's, but at least 100, with a warning if that is more."""
    ls_iterations: int | None = None
    """Iteration limit of each line search; None: the model's, but at least 50, likewise."""

    @property
    def dense(self) -> bool:
        """Whether these kernels need a dense Jacobian."""
        return self.ordered or bool(self.fused_solver)


PACKAGE: Final = Kernels()
"""mujoco_warp's own kernels."""


class Stages(Protocol):
    """Launches of a step and of its parts."""

    ordered: bool
    """Whether all sums have a fixed order."""
    unrolls: bool
    """Whether the solver's iterations are unrolled under torch capture."""

    def step(self, model: Any, data: Any) -> None:
        """Launch one physics step."""

    def position(self, model: Any, data: Any) -> None:
        """Launch the position stage, without factoring the inertia."""

    def tendon(self, model: Any, data: Any) -> None:
        """Launch lengths and Jacobians of tendons."""

    def slopes(self, model: Any, data: Any, out: wp.array) -> None:
        """Launch M - h ∂τ/∂v of the implicitfast integrator, in the layout of M, into `out` (W, nC)."""

    def summing(self, model: Any) -> Any:
        """The model to pass to mujoco_warp's stages when they are launched one by one."""


class PackageStages:
    """mujoco_warp's own kernels."""

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
    """`mujoco_warp.step` for Euler, implicit and implicitfast, stage by stage, with another solver.

    Args:
        solve: the solver.
        unrolls: whether the solver's iterations are unrolled under torch capture.
    """

    def __init__(self, solve: Solver, unrolls: bool) -> None:
        self._solve = solve
        self.unrolls = unrolls

    def of(self, stage: str, model: Any) -> Any:
        """The model to pass to a stage: inertia, constraint, velocity, actuation, acceleration or integration."""
        return model

    def actuation(self, model: Any, data: Any) -> None:
        """Launch the forces of actuators."""
        mjw.fwd_actuation(self.of("actuation", model), data)

    def integrate(self, model: Any, data: Any) -> None:
        """Launch the integration."""
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
    """A copy of the model with a dense Jacobian, which this package's solvers need."""
    if mjm.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE:
        return mjm
    changed = copy.copy(mjm)
    changed.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return changed


def with_options(model: Any, **options: Any) -> Any:
    """A copy of mujoco_warp's model with other options and the same arrays."""
    changed, opt = copy.copy(model), copy.copy(model.opt)
    # These copies are not sealed: no recorded graph reads their attributes.
    for name, value in options.items():
        object.__setattr__(opt, name, value)
    object.__setattr__(changed, "opt", opt)
    return changed
