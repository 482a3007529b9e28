"""`tape_per_substep` and `tape_all`: exact gradients by the adjoint of every substep.

Both tapes checkpoint each substep's state and acceleration in one buffer, which is copied for each saved env step.
`tape_per_substep` recomputes the position and velocity stages in the backward pass (the acceleration is known, so there
is no solve); `tape_all` stores them.
"""

import warnings
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import torch
import warp as wp
from torch import Tensor

from msk_ray.step.adjoint import StepAdjoint
from msk_ray.step.adjoint.coverage.check import check_supported
from msk_ray.step.adjoint.parameters import ParameterAdjoint
from msk_ray.step.adjoint.stages.pull_counter import PullCounter
from msk_ray.step.adjoint.stages.residual import ResidualGauge
from msk_ray.step.adjoint.stages.substep_pullback import substep_pullback
from msk_ray.step.autograd.backward import (
    INPUTS,
    Backward,
    ExternalForces,
    InputGradients,
    Needs,
    StepState,
)
from msk_ray.step.autograd.buffers import applied_of, device_of, stream_of
from msk_ray.step.autograd.jacobian import rows_of, state_size, unit_cotangents
from msk_ray.step.autograd.pool import Pool
from msk_ray.step.autograd.tangent import Tangent
from msk_ray.step.errors import UnsupportedModelError
from msk_ray.step.forward import Graph, WorldBatch

_RESIDUAL_TOLERANCE = 1e-3
"""A world's substep counts as unconverged if the solver left more than this share of its forces unbalanced,
|Ma - τ - Jᵀf| / |(Ma, τ, Jᵀf)|."""
UNCONVERGED_BOUND = 0.01
"""Share of unconverged substeps, over all worlds, above which there is a warning."""
JACOBIAN_WORLDS = 131072
"""Largest number of worlds in which `jacobian` pulls rows back at the same time."""

# Arrays of mujoco_warp.Data that the adjoint of a substep reads, besides the checkpointed state.
_KEPT_DATA = (
    *("cdof", "cdof_dot", "cvel", "cinert", "M", "nefc", "nacon", "subtree_com", "xipos", "xpos", "xquat", "xmat"),
    *("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "ten_J", "ten_length", "ten_velocity", "act_dot"),
    *("actuator_velocity", "actuator_force"),
    *("actuator_length", "moment_rownnz", "moment_rowadr", "moment_colind", "actuator_moment", "qfrc_actuator"),
)
_KEPT_EFC = ("type", "id", "J", "J_rownnz", "J_rowadr", "J_colind", "D", "aref", "frictionloss", "pos", "margin")
_KEPT_CONTACT = (
    *("dist", "pos", "frame", "includemargin", "friction", "solref", "solreffriction", "solimp", "dim", "geom"),
    *("efc_address", "worldid", "geomcollisionid"),
)


def _solved(data: Any, mjm: mujoco.MjModel) -> wp.array:
    """The acceleration to which the other arrays of `data` belong; for RK4, the last stage's."""
    return data.qacc_warmstart if mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else data.qacc


class _Tape(Backward):
    """The shared part of the two tapes: checkpoints, and the backward graph.

    Args:
        substep_grad_clip: bound on the Euclidean norm of each world's state cotangent between substeps, in the
            cotangent's own units; the direction is kept. None for no bound.
    """

    covers_applied = True
    covers_parameters = True

    def __init__(self, substep_grad_clip: float | None = None) -> None:
        self.substep_grad_clip = substep_grad_clip
        self._warned: set[str] = set()  # shared with the modes that replace this one

    def attach(self, batch: WorldBatch) -> None:
        mjm, worlds = batch.mjm, batch.nworld
        check_supported(batch.structure, self.name)
        self._batch = batch
        self._device = device_of(batch)
        self._pulled = PullCounter(batch.device)
        with wp.ScopedDevice(batch.device):
            self._adjoint = StepAdjoint(batch.structure, batch.model, batch.data, batch.stages)
            pool = Pool(batch.device)
            self._states: list[dict[str, wp.array]] = [{} for _ in range(batch.substeps)]
            self._last: dict[str, wp.array] = {}
            for state in (*self._states, self._last):
                pool.floats(state, "qpos", worlds, mjm.nq)
                pool.floats(state, "qvel", worlds, mjm.nv)
            for state in self._states:
                pool.floats(state, "act", worlds, mjm.na)
                pool.floats(state, "qacc", worlds, mjm.nv)
            self._prepare(pool)
            self._saved = pool.allocate()
            self._raw_qpos = wp.zeros((worlds, mjm.nq), dtype=float)
            self._clipped = wp.zeros(worlds, dtype=int)
            self._gauge = ResidualGauge(self._adjoint.inertia_address, worlds, _RESIDUAL_TOLERANCE)
        self._ctrl = wp.to_torch(batch.data.ctrl, requires_grad=False)
        adjoint = self._adjoint
        self.cotangent = StepState(
            *(wp.to_torch(a, requires_grad=False) for a in (self._raw_qpos, adjoint.grad_qvel, adjoint.grad_act))
        )
        self._grad_ctrl = wp.to_torch(adjoint.grad_ctrl, requires_grad=False)
        self._applied = applied_of(batch.data)
        self._graphs: dict[tuple[bool, tuple[str, ...]], Graph] = {}
        self._parameters: dict[tuple[str, ...], ParameterAdjoint] = {}
        self._columns: dict[tuple[str, ...], Tensor] = {}
        self._rows: dict[int, TapePerSubstep] = {}

    def _prepare(self, pool: Pool) -> None:
        """Request further arrays in the buffer that is copied for each saved step."""

    @abstractmethod
    def _pull_back(self, k: int, qvel_next: wp.array, *extras: Any) -> None:
        """Launch the pullback of substep k; `qvel_next` (W, nv) is the velocity after it."""

    def save(
        self, ctrl: Tensor, start: StepState, end: StepState, applied: ExternalForces | None = None
    ) -> tuple[Tensor, ...]:
        forces = () if applied is None else (force.detach().clone() for force in applied)
        return (ctrl.detach().clone(), self._saved.clone(), *forces)

    @torch.no_grad()
    def vjp(self, saved: tuple[Tensor, ...], cotangent: StepState, needs: Needs) -> InputGradients:
        self._warn_of_unconverged(self._gauge.unconverged())
        ctrl, kept, *forces = saved
        self.ready(bool(forces), needs.parameters)
        self._ctrl.copy_(ctrl)
        self._saved.copy_(kept)
        for view, value in zip(self._applied, forces, strict=False):
            view.copy_(value)
        gradients = self.pull(cotangent, bool(forces), needs.parameters)
        if forces:
            for view in self._applied:  # the next step may have no applied forces
                view.zero_()
        return InputGradients.of(
            {name: getattr(gradients, name).clone() for name in INPUTS if getattr(needs, name)},
            gradients.parameters,
        )

    def pullbacks(self) -> tuple[Callable[[], None], ...]:
        return (self.launch_backward,)

    def ready(self, applied: bool, names: tuple[str, ...] = ()) -> None:
        """Record the backward pass of steps with or without applied forces, with gradients of the named parameters.

        On CUDA this runs it once, which leaves the checkpoints undefined.
        """
        if (applied, names) not in self._graphs:
            if names and self._batch.ordered:
                raise UnsupportedModelError(
                    f"gradients of {', '.join(names)} have no fixed order on a GPU: make the Simulation with "
                    "kernels=Kernels(ordered=False)"
                )
            if names and names not in self._parameters:
                self._parameters[names] = parameters = ParameterAdjoint(self._adjoint, names)
                columns = [torch.arange(c.start, c.stop) for c in (parameters.columns[n] for n in names)]
                self._columns[names] = torch.cat(columns).to(self._device)
            launches = lambda: self.launch_backward(applied, names)  # noqa: E731
            self._graphs[applied, names] = Graph(launches, self._batch.device)
            self._clipped.zero_()
            self._pulled.clear()
            self._adjoint.touch_counter.clear()

    def pull(self, cotangent: StepState, applied: bool, names: tuple[str, ...] = ()) -> InputGradients:
        """Replay the backward pass of the step whose checkpoints are loaded; the next call overwrites the result."""
        for view, value in zip(self.cotangent, cotangent, strict=True):
            view.copy_(value)
        self._graphs[applied, names].replay(stream_of(self._device))
        gradients = InputGradients(self._grad_ctrl, *self.cotangent)
        if applied:
            forces = self._adjoint.cover_applied()
            views = (wp.to_torch(a, requires_grad=False) for a in (forces.grad_qfrc, forces.grad_xfrc))
            gradients = gradients._replace(**dict(zip(("qfrc_applied", "xfrc_applied"), views, strict=True)))
        if names:
            rows = wp.to_torch(self._parameters[names].rows, requires_grad=False)
            gradients = gradients._replace(parameters=rows.index_select(1, self._columns[names]))
        return gradients

    def load(self, ctrl: Tensor, states: Sequence[dict[str, wp.array]], forces: Sequence[Tensor]) -> None:
        """Load a step of a batch of w worlds, W / w copies of each: its control, checkpoints and applied forces."""
        self.ready(bool(forces))
        pairs = [(self._ctrl, ctrl), *zip(self._applied, forces, strict=False)]
        for here, there in zip(self.checkpoints, states, strict=True):
            pairs += [tuple(wp.to_torch(a, requires_grad=False) for a in (here[n], there[n])) for n in there]
        for view, value in pairs:
            view.unflatten(0, (-1, len(value))).copy_(value)

    @property
    def checkpoints(self) -> list[dict[str, wp.array]]:
        """Checkpoints of a step: the states before each substep, and the final one."""
        return [*self._states, self._last]

    @torch.no_grad()
    def jacobian(
        self, saved: tuple[Tensor, ...], start: StepState, end: StepState, tangent: Tangent
    ) -> tuple[Tensor, Tensor]:
        """Pulls back as many rows at once as fit in `JACOBIAN_WORLDS` worlds, without clipping."""
        self._warn_of_unconverged(self._gauge.unconverged())
        ctrl, kept, *forces = saved
        self._saved.copy_(kept)
        size, worlds = state_size(end), self._batch.nworld
        width = max(1, min(size, JACOBIAN_WORLDS // worlds))
        if width not in self._rows:
            self._rows[width] = TapePerSubstep()
            self._rows[width].attach(self._batch.resized(width * worlds))
        self._rows[width].load(ctrl, self.checkpoints, forces)
        rows = []
        for first in range(0, size, width):
            chunk = range(first, min(first + width, size))
            cotangents = unit_cotangents(tangent, end, chunk, width)
            gradients = self._rows[width].pull(StepState(*(part.flatten(0, 1) for part in cotangents)), bool(forces))
            split = {n: getattr(gradients, n).clone().unflatten(0, (width, worlds)) for n in INPUTS[:4]}
            rows.append(rows_of(tangent, start, InputGradients.of(split)))
        a, b = (torch.cat(parts)[:size].transpose(0, 1).contiguous() for parts in zip(*rows, strict=True))
        return a, b

    def bytes_saved(self) -> int:
        """Size of one saved env step's data [B], of all worlds together, without its control."""
        return self._saved.numel() * self._saved.element_size()

    def launch_backward(self, with_applied: bool = False, names: tuple[str, ...] = ()) -> None:
        """Launch the pullback of a whole env step, from `cotangent` of its end to the start's, in the same buffers."""
        applied = self._adjoint.cover_applied() if with_applied else None
        parameters = self._parameters[names] if names else None
        for extra in (applied, parameters):
            if extra is not None:
                extra.start()
        self._adjoint.start(self._last["qpos"], self._raw_qpos)
        for k in reversed(range(self._batch.substeps)):
            after = self._states[k + 1] if k + 1 < self._batch.substeps else self._last
            self._pull_back(k, after["qvel"], applied, parameters)
            if self.substep_grad_clip is not None and k > 0:
                self._adjoint.clip(self.substep_grad_clip, self._clipped)
        self._adjoint.finish(self._states[0]["qpos"], self._raw_qpos)
        if self._counts:
            self._pulled.launch()

    def forget(self) -> None:
        self._gauge.clear()

    def diagnostics(self) -> dict[str, float]:
        figures = self._gauge.read()
        self._warn_of_unconverged(figures["solver_unconverged_substeps"])
        if not self._counts:
            return figures
        pulled = self._pulled.read()
        if self.substep_grad_clip is not None:
            between = max(1, pulled * (self._batch.substeps - 1)) * self._batch.nworld
            figures["substep_clip_share"] = float(self._clipped.numpy().sum()) / between
            self._clipped.zero_()
        substeps = max(1, pulled) * self._batch.substeps * self._batch.nworld
        if self._adjoint.touch_counter.present:
            of_rows = [rows.diagnostics()["approximated_share"] for rows in self._rows.values()]
            figures["approximated_share"] = max([self._approximated_share(substeps), *of_rows])
        return figures

    @property
    def _counts(self) -> bool:
        """Whether a diagnostic is a share of the substeps pulled back."""
        return self.substep_grad_clip is not None or self._adjoint.touch_counter.present

    def _approximated_share(self, substeps: int) -> float:
        """Share of all worlds' substeps with a contact whose gradient is approximated. Warns when it is first above
        zero.
        """
        count, pairs = self._adjoint.touch_counter.read()
        share = count / substeps
        if count and "approximated" not in self._warned:
            self._warned.add("approximated")
            warnings.warn(
                f"the gradient is approximated in {share:.1%} of the substeps (grad/approximated_share), where it goes "
                f"through contacts of {', '.join(pairs)}",
                stacklevel=4,
            )
        return share

    def _warn_of_unconverged(self, share: float) -> None:
        """Warn when the share of unconverged substeps is first above the bound."""
        if share <= UNCONVERGED_BOUND or "unconverged" in self._warned:
            return
        self._warned.add("unconverged")
        limits, tolerance = self._batch.limits, float(self._batch.model.opt.tolerance.numpy()[0])
        warnings.warn(
            f"the constraint solver stopped before it had converged in {share:.1%} of the substeps "
            "(physics/solver_unconverged_substeps), where gradients are wrong: raise physics.iterations (now "
            f"{limits.iterations}) and physics.ls_iterations (now {limits.ls_iterations}) or lower physics.tolerance "
            f"(now {tolerance:g}); in Python, kernels=Kernels(iterations=...) and tolerance of Simulation",
            stacklevel=4,
        )


class TapePerSubstep(_Tape):
    """Checkpoints (qpos, qvel, act, qacc) of every substep; recomputes position and velocity stages in backward."""

    name = "tape_per_substep"

    def attach(self, batch: WorldBatch) -> None:
        super().attach(batch)
        self._substep = substep_pullback(self._adjoint)

    def launch_step(self, batch: WorldBatch) -> None:
        data = batch.data
        batch.begin_step()
        for k, state in enumerate(self._states):
            for name in ("qpos", "qvel", "act"):
                wp.copy(state[name], getattr(data, name))
            batch.launch_substep(data, k)
            wp.copy(state["qacc"], data.qacc)
            self._gauge.launch(data, _solved(data, batch.mjm))
        self._gauge.launch_end(batch.substeps)
        for name, array in self._last.items():
            wp.copy(array, getattr(data, name))
        batch.end_step(data)

    def _pull_back(self, k: int, qvel_next: wp.array, *extras: Any) -> None:
        data = self._batch.data
        for name, array in self._states[k].items():
            wp.copy(getattr(data, name), array)
        self._substep.pull_back(data, qvel_next, *extras)


class TapeAll(_Tape):
    """Keeps everything that the adjoint of every substep reads: nothing is recomputed, at the cost of memory."""

    name = "tape_all"

    def attach(self, batch: WorldBatch) -> None:
        if batch.mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            raise UnsupportedModelError(
                "tape_all does not differentiate integrator RK4, whose stages mujoco_warp does not keep: write "
                "physics.backward=tape_per_substep in a config, --mode tape_per_substep of gradcheck"
            )
        super().attach(batch)

    def _prepare(self, pool: Pool) -> None:
        batch = self._batch
        self._datas = []
        for _ in self._states:
            data = batch.resized(batch.nworld).data
            data.overflow = batch.data.overflow
            data.ctrl = batch.data.ctrl
            data.qfrc_applied, data.xfrc_applied = batch.data.qfrc_applied, batch.data.xfrc_applied
            for holder, names in ((data, _KEPT_DATA), (data.efc, _KEPT_EFC), (data.contact, _KEPT_CONTACT)):
                for name in names:
                    pool.adopt(holder, name)
            self._datas.append(data)

    def launch_step(self, batch: WorldBatch) -> None:
        before = batch.data
        batch.begin_step()
        for k, (state, data) in enumerate(zip(self._states, self._datas, strict=True)):
            for name in ("qpos", "qvel", "act", "qacc_warmstart", "time"):
                wp.copy(getattr(data, name), getattr(before, name))
            for name in ("qpos", "qvel", "act"):
                wp.copy(state[name], getattr(before, name))
            batch.launch_substep(data, k)
            wp.copy(state["qacc"], data.qacc)
            self._gauge.launch(data, _solved(data, batch.mjm))
            before = data
        self._gauge.launch_end(batch.substeps)
        for name in ("qpos", "qvel", "act"):
            wp.copy(getattr(batch.data, name), getattr(before, name))
        for name, array in self._last.items():
            wp.copy(array, getattr(before, name))
        batch.end_step(before)

    def last_data(self, batch: WorldBatch) -> Any:
        return self._datas[-1]

    def _pull_back(self, k: int, qvel_next: wp.array, *extras: Any) -> None:
        data = self._datas[k]
        for name, array in self._states[k].items():
            wp.copy(getattr(data, name), array)
        self._adjoint.pull_back(data, qvel_next, *extras)


__all__ = ["TapeAll", "TapePerSubstep"]
