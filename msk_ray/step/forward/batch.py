"""`nworld` copies of one model, stepped together by an unmodified mujoco_warp."""

import copy
from collections.abc import Iterable
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from numpy.typing import NDArray

from msk_ray.step.errors import ConfigError, UnsupportedModelError
from msk_ray.step.forward.accepted import check_accepted
from msk_ray.step.forward.capacity import UNKNOWN, Capacity, default_capacity, geometric_bound, scalar_rows
from msk_ray.step.forward.fused import FusedSolver, check_fused
from msk_ray.step.forward.graph import joined_stream
from msk_ray.step.forward.iterations import IterationWatch
from msk_ray.step.forward.ordered import OrderedStages, check_ordered
from msk_ray.step.forward.overflow import LossWatch, cured, loss_error, needed
from msk_ray.step.forward.parameters import check_names, open_arrays, structure
from msk_ray.step.forward.sealed import ModelWatch, seal
from msk_ray.step.forward.solver_limits import choose_limits, tell_raised
from msk_ray.step.forward.stages import PACKAGE, ComposedStages, Kernels, PackageStages, Stages, dense, with_options
from msk_ray.step.forward.standing import StandingCylinders, stands_on_planes


def refresh_velocity(mjm: mujoco.MjModel, model: Any, data: Any) -> None:
    """Launch the velocity stage early where constraints are built from it.

    mujoco_warp 4.0.0 builds connect and weld rows in its position stage from the body velocities in `data`, which are
    those of the step before unless this comes first. C MuJoCo takes the present ones.
    """
    if np.any(np.isin(mjm.eq_type, [int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)])):
        mjw.kinematics(model, data)
        mjw.com_pos(model, data)
        mjw.com_vel(model, data)


class WorldBatch:
    """Model and data of `nworld` worlds on one device, with the launches of one env step.

    An env step is `substeps` calls of `mujoco_warp.step` under one control. It is a pure function of
    (ctrl, qpos, qvel, act): the solver starts cold at its first substep and warm at the others.

    Args:
        mjm: the C MuJoCo model, which must not change while the batch lives.
        capacity: contacts and constraint rows a world. Where it is 0, a bound from the geometry where that is small,
            else what a short probe in C MuJoCo needed and half as much again.
        tolerance: solver tolerance, below mujoco_warp's floor of 1e-6 if wanted.
        kernels: which kernels a step is made of, and how many iterations its solver may take.

    Attributes:
        mjm: the C MuJoCo model.
        model, data: mujoco_warp's copies on the device. The model's arrays cannot be replaced, as recorded graphs
            would not follow.
        nworld: number of worlds W.
        parameters: names of the fields of the model that have a value for each world.
        structure: the MjModel with everything present that these may switch on.
        substeps: physics steps an env step.
        device: the Warp device.
        stages: launches of a step and of its parts.
        limits: most iterations of the solver and of each line search.
        capacity: contacts and rows per world that fit into `data`.
        losses: what steps lost to full buffers; check it between steps.
        iterations: how many iterations the solver took in each substep.
        unrolled_iterations: the solver's iteration limit in each substep of steps that are recorded into another
            library's capture, and of all steps in a fixed order. In a capture the loop is unrolled, so that each
            iteration costs time even where no world needs it. None: the model's limit.

    Raises:
        UnsupportedModelError: mujoco_warp cannot load the model, or would step it unlike C MuJoCo.
        ConfigError: a limit of the solver is below 1.
    """

    def __init__(
        self,
        mjm: mujoco.MjModel,
        nworld: int,
        substeps: int,
        device: str,
        *,
        capacity: Capacity = UNKNOWN,
        tolerance: float | None = None,
        kernels: Kernels = PACKAGE,
    ) -> None:
        check_accepted(mjm)
        if kernels.ordered:
            check_ordered(mjm)
        if kernels.fused_solver:
            check_fused(mjm)
        self.mjm = mjm
        self.substeps = substeps
        self.device = wp.get_device(device)
        self.parameters: tuple[str, ...] = ()
        self.kernels = kernels
        self.structure = self._structure()
        self._tolerance = tolerance
        self.limits = choose_limits(mjm, kernels.iterations, kernels.ls_iterations)
        self.stages: Stages
        self._model, self.stages = self._load(nworld)
        if self._solves:
            tell_raised(mjm, kernels.iterations, kernels.ls_iterations)
        self.unrolled_iterations: tuple[int, ...] | None = None
        self._watch = ModelWatch(mjm)
        self._given = capacity
        start, self._bound = default_capacity(self.structure) if not all(self._given) else (self._given, None)
        self._allocate(nworld, Capacity(capacity.contacts or start.contacts, capacity.rows or start.rows))

    def _structure(self) -> mujoco.MjModel:
        model = structure(self.mjm, self.parameters)
        return dense(model) if self.kernels.dense else model

    @property
    def _solves(self) -> bool:
        """Whether there can be contacts or constraint rows."""
        return geometric_bound(self.structure) != Capacity(0, 0)

    def _load(self, nworld: int) -> tuple[Any, Stages]:
        """mujoco_warp's copy of the model, sealed, and the launches of its step."""
        with wp.ScopedDevice(self.device):
            try:
                model = mjw.put_model(self.structure)
            except (NotImplementedError, ValueError) as error:
                raise UnsupportedModelError(f"mujoco_warp cannot load the model: {error}{_advice(error)}") from error
            if self._tolerance is not None:
                # put_model clamps to 1e-6; the adjoint holds at the optimum only, so it may ask for less.
                model.opt.tolerance = wp.array([self._tolerance], dtype=float)
            model.opt.iterations, model.opt.ls_iterations = self.limits
            model.opt.warn_overflow = 0  # read back by `losses`, not printed from kernels
            model.ncam = model.nlight = 0  # nothing looks: two launches less a substep
            if not self._solves:
                model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT  # nothing looks for what cannot be
            open_arrays(self.mjm, model, self.parameters, nworld)
            if stands_on_planes(self.structure):
                model.callback.contactfilter = StandingCylinders(self.structure).launch
            stages = self._make_stages(model)
        seal(model, "batch.model")
        return model, stages

    def _make_stages(self, model: Any) -> Stages:
        fused = FusedSolver() if self.kernels.fused_solver else None
        if self.kernels.ordered:
            return OrderedStages(self.structure, model, fused)
        return PackageStages() if fused is None else ComposedStages(fused, unrolls=False)

    @property
    def ordered(self) -> bool:
        """Whether everything is added up in a fixed order."""
        return self.kernels.ordered

    @property
    def model(self) -> Any:
        """mujoco_warp's model."""
        return self._model

    def _allocate(self, nworld: int, capacity: Capacity) -> None:
        self.nworld = nworld
        self.capacity = capacity
        with wp.ScopedDevice(self.device):
            self.data = mjw.make_data(self.structure, nworld=nworld, nconmax=capacity.contacts, njmax=capacity.rows)
            if capacity.rows == 0:
                # Integrators read M qacc where the solver leaves it, which mujoco_warp leaves out without rows: then it
                # is the smooth force.
                self.data.efc.Ma = self.data.qfrc_smooth
        self.losses = LossWatch(self.data, self.device)
        self.iterations = IterationWatch(self.substeps, nworld, self.device)

    def resized(self, nworld: int, capacity: Capacity | None = None) -> "WorldBatch":
        """Another batch of the same model, which both share, with `nworld` worlds."""
        self.check_model()
        other = copy.copy(self)
        other._allocate(nworld, capacity or self.capacity)
        return other

    def with_parameters(self, names: Iterable[str]) -> "WorldBatch":
        """Another batch of as many worlds, in whose model the named fields have a value for each world too.

        Raises:
            ConfigError: a name is no parameter, or the model has none of it.
            UnsupportedModelError: the model uses something with which the parameter cannot be varied.
        """
        self.check_model()
        check_names(self.mjm, names)
        other = copy.copy(self)
        other.parameters = tuple(sorted({*self.parameters, *names}))
        other.structure = other._structure()
        other._model, other.stages = other._load(self.nworld)
        more = scalar_rows(other.structure) - scalar_rows(self.structure)
        if self._bound is not None:
            other._bound = self._bound._replace(rows=self._bound.rows + more)
        rows = self.capacity.rows + (0 if self._given.rows else more)
        other._allocate(self.nworld, self.capacity._replace(rows=rows))
        return other

    def check_model(self, thorough: bool = False) -> None:
        """Raise ConfigError if the MjModel was edited since; meshes and height fields are compared if `thorough`."""
        self._watch.check(thorough)

    def growth(self, wanted: Capacity) -> Capacity:
        """The part of `wanted` that may be allocated: sizes that were given stay, and so do bounds of the geometry."""
        if self._bound is not None:
            wanted = wanted.at_most(self._bound)
        return Capacity(
            self.capacity.contacts if self._given.contacts else max(wanted.contacts, self.capacity.contacts),
            self.capacity.rows if self._given.rows else max(wanted.rows, self.capacity.rows),
        )

    def larger(self) -> "WorldBatch":
        """The batch to repeat a step with that lost something here; waits for the device.

        Raises:
            SimulationError: the user fixed the buffer sizes, or larger ones would not help.
        """
        lost, _, peak = self.losses.read()
        wanted = needed(lost, self.capacity, peak)
        allowed = self.growth(wanted)
        if not cured(lost, self.capacity, allowed):
            raise loss_error(lost, self.capacity, wanted)
        return self.resized(self.nworld, allowed)

    def raise_losses(self) -> None:
        """Raise SimulationError if a step that the device has finished lost contacts or constraint rows."""
        if self.losses.heard():
            lost, _, peak = self.losses.read()
            raise loss_error(lost, self.capacity, needed(lost, self.capacity, peak))

    def begin_step(self) -> None:
        """Launch what makes an env step independent of the one before."""
        self.data.qacc_warmstart.zero_()
        self.data.time.zero_()

    def launch_step(self) -> None:
        """Launch one env step on the current contents of data.{ctrl, qpos, qvel, act}."""
        self.begin_step()
        for k in range(self.substeps):
            self.launch_substep(self.data, k)
        self.end_step(self.data)

    def end_step(self, data: Any) -> None:
        """Launch the look for losses of an env step whose last substep was made in `data`: its last launch.

        Worlds that lost contacts or rows get NaN for (qpos, qvel, act), so that nothing can take them for states.
        """
        self.losses.launch(data)

    def launch_substep(self, data: Any, k: int) -> None:
        """Launch substep k of an env step on `data`, this batch's own or another of the same model and size."""
        captured = joined_stream() is not None
        # In a fixed order, what is recorded and what is not have to stop at the same iteration.
        limited = self.stages.unrolls and (captured or self.ordered)
        model = self._limited(k, conditional=not captured) if limited else self.model
        refresh_velocity(self.mjm, model, data)
        self.stages.step(model, data)
        if self.stages.unrolls:
            self.iterations.launch(data, k)

    def _limited(self, k: int, conditional: bool) -> Any:
        """The model with the iteration limit of substep k, with or without conditional graph nodes; the same arrays."""
        limit = self.model.opt.iterations
        if self.unrolled_iterations is not None:
            limit = min(self.unrolled_iterations[k], limit)
        conditional = conditional and bool(self.model.opt.graph_conditional)
        return with_options(self.model, graph_conditional=conditional, iterations=limit)

    def set_contact_pairs(self, fields: dict[str, NDArray[np.float64]]) -> None:
        """Change what contact pairs are made of, from the next step on; recorded graphs follow.

        The MjModel keeps what it was compiled with.

        Args:
            fields: of solref (P, 2), solreffriction (P, 2), solimp (P, 5), friction (P, 5), those that change, for the
                P pairs in the model's order.

        Raises:
            ConfigError: one of them is an open parameter, whose value is an argument of the step.
        """
        varied = [name for name in fields if f"pair_{name}" in self.parameters]
        if varied:
            raise ConfigError(
                f"pair_{varied[0]} is a parameter of this simulation's steps, which write it: give step the value "
                f"as parameters={{'pair_{varied[0]}': ...}}"
            )
        for name, value in fields.items():
            array = getattr(self.model, f"pair_{name}")
            # In place: a recorded graph reads this memory.
            array.assign(np.asarray(value, np.float32).reshape(*array.shape, -1))


_ADVICE = {
    "mjSOL_PGS": 'write solver="Newton", or "CG", in the <option> of the model',
    "mjINT_": 'write integrator="Euler", "implicitfast" or "RK4" in the <option> of the model',
}


def _advice(error: Exception) -> str:
    """What to write instead of an option that mujoco_warp does not have."""
    text = str(error)
    return next((f" {advice}" for name, advice in _ADVICE.items() if name in text), "")
