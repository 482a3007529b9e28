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
from msk_ray.step.forward.capacity import UNKNOWN, Capacity, convex_room, default_capacity, geometric_bound, scalar_rows
from msk_ray.step.forward.contact_watch import ContactQuery, ContactWatch
from msk_ray.step.forward.fused import FusedSolver, check_fused, choose_fused
from msk_ray.step.forward.graph import joined_stream
from msk_ray.step.forward.iterations import IterationWatch
from msk_ray.step.forward.model_support import check_model_support
from msk_ray.step.forward.model_watch import ModelWatch, seal
from msk_ray.step.forward.ordered import OrderedStages, check_ordered
from msk_ray.step.forward.overflow import LossWatch, cured, loss_error, needed
from msk_ray.step.forward.parameters import check_names, open_arrays, structure
from msk_ray.step.forward.solver_limits import choose_limits, warn_raised_limits
from msk_ray.step.forward.stages import PACKAGE, ComposedStages, Kernels, PackageStages, Stages, dense, with_options
from msk_ray.step.forward.standing_cylinders import StandingCylinders, has_cylinders_and_planes


def refresh_velocity(mjm: mujoco.MjModel, model: Any, data: Any) -> None:
    """Launch the velocity stage early, for models with connect and weld constraints.

    mujoco_warp 4.0.0 builds their rows in its position stage from the body velocities in `data`, which are still the
    previous step's unless this comes first. C MuJoCo uses the current ones.
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
        capacity: contacts and constraint rows per world. Where it is 0, a bound from the geometry if that is small,
            otherwise 1.5 times what a short probe in C MuJoCo needed.
        tolerance: solver tolerance; it may be below mujoco_warp's floor of 1e-6.
        kernels: kernels of a step, and limits on its solver's iterations.

    Attributes:
        kernels: the same, with the choice of the solver's made.
        mjm: the C MuJoCo model.
        model, data: mujoco_warp's copies on the device. The model's arrays must not be replaced, because recorded
            graphs keep using the old ones.
        nworld: number of worlds W.
        parameters: names of the model fields that have a value for each world.
        structure: the MjModel with all features enabled that these parameters may enable.
        substeps: physics steps per env step.
        device: the Warp device.
        stages: launches of a step and of its parts.
        limits: iteration limits of the solver and of each line search.
        capacity: contacts and rows per world that fit into `data`.
        losses: contacts and rows lost to full buffers; check it between steps.
        iterations: counts the solver's iterations in each substep.
        contacts: contacts between groups of geoms in each substep.
        measures_sensors: whether steps fill `data.sensordata`, which then belongs to the state before the last substep.
        unrolled_iterations: the solver's iteration limit in each substep, for steps recorded into another library's
            capture, and for all steps with ordered sums. In a capture the loop is unrolled, so that each iteration
            costs time even if no world needs it. None: the model's limit.

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
        check_model_support(mjm)
        if kernels.ordered:
            check_ordered(mjm)
        if kernels.fused_solver:
            check_fused(mjm)
        self.mjm = mjm
        self.substeps = substeps
        self.device = wp.get_device(device)
        self.parameters: tuple[str, ...] = ()
        self._given = capacity
        start, self._bound = default_capacity(mjm) if not all(capacity) else (capacity, None)
        start = Capacity(capacity.contacts or start.contacts, capacity.rows or start.rows)
        if kernels.fused_solver is None:
            kernels = kernels._replace(fused_solver=choose_fused(mjm, start.rows))
        self.kernels = kernels
        self.structure = self._structure()
        self._tolerance = tolerance
        self.limits = choose_limits(mjm, kernels.iterations, kernels.ls_iterations)
        self.stages: Stages
        self._model, self.stages = self._load(nworld)
        if self._solves:
            warn_raised_limits(mjm, kernels.iterations, kernels.ls_iterations)
        self.unrolled_iterations: tuple[int, ...] | None = None
        self.measures_sensors = False
        self._watch = ModelWatch(mjm)
        self._allocate(nworld, start, ())

    def _structure(self) -> mujoco.MjModel:
        model = structure(self.mjm, self.parameters)
        return dense(model) if self.kernels.dense else model

    @property
    def _solves(self) -> bool:
        """Whether there can be contacts or constraint rows."""
        return geometric_bound(self.structure) != Capacity(0, 0)

    def _load(self, nworld: int) -> tuple[Any, Stages]:
        """mujoco_warp's copy of the model, sealed, and the stages of its step."""
        with wp.ScopedDevice(self.device):
            try:
                model = mjw.put_model(self.structure)
            except (NotImplementedError, ValueError) as error:
                raise UnsupportedModelError(f"mujoco_warp cannot load the model: {error}{_advice(error)}") from error
            if self._tolerance is not None:
                # put_model clamps to 1e-6, but the adjoint is exact at the optimum only, and may need less.
                model.opt.tolerance = wp.array([self._tolerance], dtype=float)
            model.opt.iterations, model.opt.ls_iterations = self.limits
            model.opt.warn_overflow = 0  # `losses` reports overflows; kernels need not print them
            model.ncam = model.nlight = 0  # unused: saves two launches per substep
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR  # `launch_substep` enables them
            if not self._solves:
                model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT  # skip constraints: no rows possible
            open_arrays(self.mjm, model, self.parameters, nworld)
            if has_cylinders_and_planes(self.structure):
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
        """Whether all sums have a fixed order."""
        return self.kernels.ordered

    @property
    def model(self) -> Any:
        """mujoco_warp's model."""
        return self._model

    def _allocate(self, nworld: int, capacity: Capacity, queries: Iterable[ContactQuery]) -> None:
        self.nworld = nworld
        self.capacity = capacity
        with wp.ScopedDevice(self.device):
            self.data = mjw.make_data(
                self.structure,
                nworld=nworld,
                nconmax=capacity.contacts,
                nccdmax=convex_room(self.structure, capacity.contacts),
                njmax=capacity.rows,
            )
            if capacity.rows == 0:
                # Integrators read M qacc from the output of the solver, which mujoco_warp skips without rows: then it
                # is the smooth force.
                self.data.efc.Ma = self.data.qfrc_smooth
        self.losses = LossWatch(self.data, self.device)
        self.iterations = IterationWatch(self.substeps, nworld, self.device)
        self.contacts = ContactWatch(self.model, self.data, self.substeps)
        for query in queries:
            self.contacts.add(query)

    def resized(self, nworld: int, capacity: Capacity | None = None) -> "WorldBatch":
        """Another batch with `nworld` worlds, which shares this one's model."""
        self.check_model()
        other = copy.copy(self)
        other._allocate(nworld, capacity or self.capacity, self.contacts.queries)
        return other

    def with_parameters(self, names: Iterable[str]) -> "WorldBatch":
        """Another batch with as many worlds, whose model also has a value of the named fields for each world.

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
        other._allocate(self.nworld, self.capacity._replace(rows=rows), self.contacts.queries)
        return other

    def check_model(self, thorough: bool = False) -> None:
        """Raise ConfigError if the MjModel was edited; `thorough` also compares meshes and height fields."""
        self._watch.check(thorough)

    def growth(self, wanted: Capacity) -> Capacity:
        """`wanted`, limited to what may be allocated: given sizes stay fixed, and geometric bounds are not exceeded."""
        if self._bound is not None:
            wanted = wanted.at_most(self._bound)
        return Capacity(
            self.capacity.contacts if self._given.contacts else max(wanted.contacts, self.capacity.contacts),
            self.capacity.rows if self._given.rows else max(wanted.rows, self.capacity.rows),
        )

    def larger(self) -> "WorldBatch":
        """A larger batch in which to repeat a step that lost something; waits for the device.

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
        if self.losses.any_lost():
            lost, _, peak = self.losses.read()
            raise loss_error(lost, self.capacity, needed(lost, self.capacity, peak))

    def begin_step(self) -> None:
        """Launch the resets that make an env step independent of the previous one."""
        self.data.qacc_warmstart.zero_()
        self.data.time.zero_()

    def launch_step(self) -> None:
        """Launch one env step on the current contents of data.{ctrl, qpos, qvel, act}."""
        self.begin_step()
        for k in range(self.substeps):
            self.launch_substep(self.data, k)
        self.end_step(self.data)

    def end_step(self, data: Any) -> None:
        """Launch the check for losses, as the last launch of an env step whose last substep was computed in `data`.

        Worlds that lost contacts or rows get NaN for (qpos, qvel, act), so that nothing mistakes them for states.
        """
        self.losses.launch(data)

    def launch_substep(self, data: Any, k: int) -> None:
        """Launch substep k of an env step on `data`, this batch's own or another of the same model and size."""
        captured = joined_stream() is not None
        # With ordered sums, recorded and eager steps must stop at the same iteration.
        limited = self.stages.unrolls and (captured or self.ordered)
        model = self._limited(k, conditional=not captured) if limited else self.model
        if self.measures_sensors:
            model = with_options(model, disableflags=model.opt.disableflags & ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR))
        refresh_velocity(self.mjm, model, data)
        self.stages.step(model, data)
        if self.stages.unrolls:
            self.iterations.launch(data, k)
        self.contacts.launch(data, k)

    def _limited(self, k: int, conditional: bool) -> Any:
        """The model with the iteration limit of substep k, with or without conditional graph nodes; the same arrays."""
        limit = self.model.opt.iterations
        if self.unrolled_iterations is not None:
            limit = min(self.unrolled_iterations[k], limit)
        conditional = conditional and bool(self.model.opt.graph_conditional)
        return with_options(self.model, graph_conditional=conditional, iterations=limit)

    def set_contact_pairs(self, fields: dict[str, NDArray[np.float64]]) -> None:
        """Change parameters of contact pairs, from the next step on, also in recorded graphs.

        The MjModel is not changed.

        Args:
            fields: new values of solref (P, 2), solreffriction (P, 2), solimp (P, 5) or friction (P, 5), for the P
                pairs in the model's order.

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
            # In place, because recorded graphs read this memory.
            array.assign(np.asarray(value, np.float32).reshape(*array.shape, -1))


_ADVICE = {
    "mjSOL_PGS": 'write solver="Newton", or "CG", in the <option> of the model',
    "mjINT_": 'write integrator="Euler", "implicitfast" or "RK4" in the <option> of the model',
}


def _advice(error: Exception) -> str:
    """What to write instead of an option that mujoco_warp does not have."""
    text = str(error)
    return next((f" {advice}" for name, advice in _ADVICE.items() if name in text), "")
