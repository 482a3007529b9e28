"""`StepAdjoint`: the exact vector-Jacobian product of one `mujoco_warp.step`, as a fixed sequence of launches.

The implicit function theorem at the solver's optimum a (B: damping the integrator treats implicitly, S: minus the
slope of the constraint forces):

    (M + hB) μ = h v̄' ,  (M + JᵀSJ) λ = M μ ,
    Φ(q, v, act, u) = λᵀ(M a - τ) - (Jλ)ᵀ f(J a - aref) - μᵀ(M (a - â) - h B â)   with a, â, λ, μ held fixed,
    gradients of (q, v, act, u)  -=  ∂Φ/∂(q, v, act, u).
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol

import mujoco
import numpy as np
import warp as wp

from msk_ray.step.adjoint.groups import Substep
from msk_ray.step.adjoint.laws.actuators import ActuatorForces
from msk_ray.step.adjoint.laws.applied_forces import AppliedForces
from msk_ray.step.adjoint.laws.bodies import Bodies
from msk_ray.step.adjoint.laws.contacts import ContactForces
from msk_ray.step.adjoint.laws.equality import launch_anchors
from msk_ray.step.adjoint.laws.fluid import launch_fluid
from msk_ray.step.adjoint.laws.joint_springs import launch_turning_springs
from msk_ray.step.adjoint.laws.rows import ConstraintLaws
from msk_ray.step.adjoint.laws.scalar_rows import launch_scalar_rows
from msk_ray.step.adjoint.laws.site_pairs import SitePairForces
from msk_ray.step.adjoint.laws.tendons import Tendons
from msk_ray.step.adjoint.laws.transmission import launch_transmissions
from msk_ray.step.adjoint.stages.integrate import Integrator
from msk_ray.step.adjoint.stages.solve import LinearSystems
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.model_tree import between_sites
from msk_ray.step.forward.stages import PackageStages, Stages

_ANCHORED = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


_Launch = Callable[[Substep], None]
"""Launches one part of ∂Φ at a substep; fields of λ, μ, a and a - â, and the laws of the rows, must be there."""


class Watcher(Protocol):
    """What else is launched in a substep's pullback."""

    gradients: Mapping[Any, Any]
    """Groups of gradients that laws add to, by their types."""

    def launch_first(self, at: Substep, qvel_next: wp.array) -> None:
        """Launch its kernels while the cotangents are those of the state after the substep."""

    def launch(self, at: Substep) -> None:
        """Launch its kernels when the multipliers, and the cotangents of contacts and tendons, are there."""


class StepAdjoint:
    """Buffers and launches of one substep's pullback for `nworld` worlds.

    `pull_back` reads a `mujoco_warp.Data` that holds the position and velocity stages of the state before the
    substep (as `mujoco_warp.step` leaves them, except qpos, qvel and act, which must be the state before it) and
    turns the cotangents below from those of the state after the substep into those of the state before.

    `stages` are those of the batch, mujoco_warp's own by default.

    Attributes:
        work, integrator, laws, contacts, tendons, actuators: buffers and launches that parameters build on.
        grad_qpos: cotangent of qpos in tangent coordinates, shape (W, nv).
        grad_qvel: shape (W, nv).
        grad_act: shape (W, na).
        grad_ctrl: shape (W, nu); every substep adds to it.
        touch_counter: how many substeps' gradients went through a contact without a derivative of its own.
        live: worlds whose gradient is wanted; the others get exact zeros. Shape (W,), int.
        applied: gradients of applied forces; None until `cover_applied` asks for them.
        inertia_address: place of M_ij (j ≤ i) in the sparse inertia, -1 where it is zero; shape (nv, nv).
    """

    def __init__(self, mjm: mujoco.MjModel, model: Any, data: Any, stages: Stages | None = None) -> None:
        self.work = work = Workspace(mjm, model, data, stages or PackageStages())
        self.grad_qpos, self.grad_qvel = work.grad_qpos, work.grad_qvel
        self.grad_act, self.grad_ctrl = work.grad_act, work.grad_ctrl
        self.live, self.touch_counter = work.live, work.touch_counter
        self.inertia_address = work.tables.inertia_address
        self.applied: AppliedForces | None = None
        with wp.ScopedDevice(work.device):
            self.integrator = Integrator(work)
            self.laws = ConstraintLaws(work)
            self.contacts = ContactForces(work, data.naconmax)
            self._systems = LinearSystems(work, self.integrator, self.laws)
            self._bodies = Bodies(work)
            self.tendons = Tendons(work) if mjm.ntendon else None
            self.actuators = ActuatorForces(work) if work.settings.actuation else None
            self._forces = _forces(work, self.contacts, self.actuators)

    def start(self, qpos: wp.array, raw_qpos: wp.array) -> None:
        """Launch the change of a raw cotangent (W, nq) at `qpos` to tangent coordinates, and find the live worlds.

        The cotangents of qvel and act must be in place.
        """
        self.integrator.start(qpos, raw_qpos)
        self.touch_counter.start()

    def cover_applied(self) -> AppliedForces:
        """Allocate the gradients of applied forces, if they are not yet there."""
        if self.applied is None:
            with wp.ScopedDevice(self.work.device):
                self.applied = AppliedForces(self.work)
        return self.applied

    def finish(self, qpos: wp.array, raw_qpos: wp.array) -> None:
        """Launch the change of the tangent gradient at `qpos` to raw coordinates (W, nq)."""
        self.integrator.finish(qpos, raw_qpos)

    def clip(self, bound: float, clipped: wp.array) -> None:
        """Launch the bound on each world's state cotangent; `clipped` (W,) counts where it acted."""
        self.integrator.clip(bound, clipped)

    def pull_back(
        self,
        data: Any,
        qvel_next: wp.array,
        applied: AppliedForces | None = None,
        parameters: Watcher | None = None,
    ) -> None:
        """Launch the pullback of one substep.

        Args:
            data: the stages of the state before it.
            qvel_next: the velocity after it, (W, nv).
            applied: gradients of applied forces, for a step that has some.
            parameters: gradients of parameters of the model, if some are wanted.
        """
        self.touch_counter.substep += 1
        at = Substep(data, None if parameters is None else parameters.gradients)
        if parameters is not None:
            parameters.launch_first(at, qvel_next)
        self.integrator.launch(at, qvel_next)
        self.laws.launch(at)
        self._systems.launch(at)
        self._bodies.launch_fields(at)
        if self.tendons is not None:
            self.tendons.launch_start(at)
        for launch in self._forces:
            launch(at)
        if applied is not None:
            applied.launch(at)
        if self.tendons is not None:
            self.tendons.launch_pullback(at)
        if parameters is not None:
            parameters.launch(at)
        self._bodies.launch_sweep(at)


def _forces(work: Workspace, contacts: ContactForces, actuators: ActuatorForces | None) -> list[_Launch]:
    """The parts that a model needs, in their order."""
    launches: list[_Launch] = []
    if np.any(np.isin(work.mjm.eq_type, _ANCHORED)):
        launches.append(partial(launch_anchors, work))
    launches.append(partial(launch_scalar_rows, work))
    launches.append(contacts.launch)
    if actuators is not None:
        launches += [actuators.launch, partial(launch_transmissions, work, actuators.bars)]
        if np.any(between_sites(work.mjm)):
            launches.append(SitePairForces(work, actuators.bars).launch)
    if work.tables.has_turning_spring:
        launches.append(partial(launch_turning_springs, work))
    if work.settings.fluid_on:
        launches.append(partial(launch_fluid, work))
    return launches
