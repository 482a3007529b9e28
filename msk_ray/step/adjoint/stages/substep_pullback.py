"""Pulling back a substep of which only the state before it was kept."""

from typing import Any, Protocol

import mujoco
import warp as wp

from msk_ray.step.adjoint.stages.recompute import recompute_stages
from msk_ray.step.adjoint.stages.runge_kutta import RungeKutta
from msk_ray.step.adjoint.step import StepAdjoint


class SubstepPullback(Protocol):
    """The pullback of one substep."""

    def pull_back(self, data: Any, qvel_next: wp.array, *extras: Any) -> None:
        """Launch it, on the cotangents of a StepAdjoint.

        Args:
            data: qpos, qvel and act before the substep, and its qacc; everything else is computed once more.
            qvel_next: the velocity after it, (W, nv).
            extras: further gradients that a StepAdjoint's `pull_back` takes.
        """


class SingleStage:
    """That of Euler and implicitfast: the stages of one state, whose acceleration is known, so nothing is solved."""

    def __init__(self, adjoint: StepAdjoint) -> None:
        self._adjoint = adjoint

    def pull_back(self, data: Any, qvel_next: wp.array, *extras: Any) -> None:
        """Launch it."""
        work = self._adjoint.work
        recompute_stages(work.mjm, work.model, data, work.stages)
        self._adjoint.pull_back(data, qvel_next, *extras)


def substep_pullback(adjoint: StepAdjoint) -> SubstepPullback:
    """The pullback for the integrator of the model."""
    if adjoint.work.mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return RungeKutta(adjoint)
    return SingleStage(adjoint)
