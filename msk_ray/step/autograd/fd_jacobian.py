"""`fd_jacobian`: gradients of any model by central differences of the whole env step."""

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from msk_ray.step.autograd.backward import INPUTS, Backward, ExternalForces, InputGradients, Needs, StepState
from msk_ray.step.autograd.buffers import device_of
from msk_ray.step.autograd.jacobian import state_size
from msk_ray.step.autograd.stepper import Stepper
from msk_ray.step.autograd.tangent import Tangent
from msk_ray.step.forward import WorldBatch

_QFRC, _XFRC = "qfrc_applied", "xfrc_applied"


class FdJacobian(Backward):
    """Perturbed copies of every world run as extra worlds of one batch; differences are taken in tangent space.

    Works with every model and integrator that mujoco_warp steps. Cost: 2·(nu + 2·nv + na) extra worlds per world, fewer
    if some inputs need no gradient.

    Accuracy: float32 rounding is divided by the perturbation, and a kink or jump inside it appears as a slope.
    Medians over 1 to 16 substeps with the defaults: 1e-6 to 5e-4 on a cartpole, 1e-5 to 1e-3 on a standing ant.
    On an ant moving in contact 1e-4 to 1e-3 for ctrl and qvel; but the qpos gradient is wrong by any factor if a
    contact begins or ends inside the perturbation: in a tenth of the states at 1 substep, in half of them at 16.

    Args:
        eps_ctrl: perturbation of ctrl [its own unit]. eps_qpos: perturbation of qpos along a tangent direction [m,
        rad]. eps_qvel: perturbation of qvel [m/s, rad/s]. eps_act: perturbation of act [its own unit]; small because
        a resting muscle's activation is just above its clamp at 0. eps_applied: perturbation of an applied force, as a
        share of the model's weight [N]; for a torque, of weight × 1 m [N m]. max_worlds: largest number of worlds in
        which perturbed copies run at the same time.
    """

    name = "fd_jacobian"
    covers_applied = True

    def __init__(
        self,
        eps_ctrl: float = 5e-3,
        eps_qpos: float = 5e-4,
        eps_qvel: float = 2e-3,
        eps_act: float = 5e-4,
        max_worlds: int = 131072,
        eps_applied: float = 1e-2,
    ) -> None:
        self.eps = {"ctrl": eps_ctrl, "qpos": eps_qpos, "qvel": eps_qvel, "act": eps_act}
        self.eps_applied = eps_applied
        self.max_worlds = max_worlds

    def attach(self, batch: WorldBatch) -> None:
        self._copies: dict[int, Stepper] = {}
        self._batch = batch
        m = batch.mjm
        self._sizes = {"ctrl": m.nu, "qpos": m.nv, "qvel": m.nv, "act": m.na, _QFRC: m.nv, _XFRC: 6 * m.nbody}
        self._weight = float(m.body_mass.sum()) * 9.81
        self._device = device_of(batch)
        self._tangent = Tangent(batch.mjm, self._device)

    def save(
        self, ctrl: Tensor, start: StepState, end: StepState, applied: ExternalForces | None = None
    ) -> tuple[Tensor, ...]:
        return (ctrl, *start, end.qpos, *(applied or ()))

    @torch.no_grad()
    def vjp(self, saved: tuple[Tensor, ...], cotangent: StepState, needs: Needs) -> InputGradients:
        inputs, qpos_end = self._inputs(saved)
        weights = torch.cat((self._tangent.project(qpos_end, cotangent.qpos), *cotangent[1:]), dim=-1)
        wanted = [name for name in INPUTS if getattr(needs, name) and self._sizes[name]]
        columns = self._columns(wanted)
        slopes = torch.empty((len(columns), self._batch.nworld), device=self._device)
        for chunk, changes in self._derivatives(columns, inputs):
            slopes[chunk.start : chunk.stop] = (changes * weights).sum(-1)
        gradients: dict[str, Tensor] = {}
        for name in wanted:
            picked = [k for k, (owner, _) in enumerate(columns) if owner == name]
            gradients[name] = slopes[picked[0] : picked[-1] + 1].T
        if "qpos" in gradients:
            gradients["qpos"] = self._tangent.lift(inputs["qpos"], gradients["qpos"])
        if _XFRC in gradients:
            gradients[_XFRC] = gradients[_XFRC].unflatten(-1, (-1, 6))
        asked = [name for name in INPUTS if getattr(needs, name)]
        return InputGradients.of({n: gradients[n] if n in gradients else torch.zeros_like(inputs[n]) for n in asked})

    @torch.no_grad()
    def jacobian(
        self, saved: tuple[Tensor, ...], start: StepState, end: StepState, tangent: Tangent
    ) -> tuple[Tensor, Tensor]:
        """Column by column: the perturbed copies give whole columns of (A, B)."""
        columns = self._columns(("qpos", "qvel", "act", "ctrl"))
        size = state_size(end)
        slopes = torch.empty((len(columns), self._batch.nworld, size), device=self._device)
        for chunk, changes in self._derivatives(columns, self._inputs(saved)[0]):
            slopes[chunk.start : chunk.stop] = changes
        a, b = slopes.permute(1, 2, 0).split([size, len(columns) - size], dim=-1)
        return a.contiguous(), b.contiguous()

    def diagnostics(self) -> dict[str, float]:
        """Share of perturbed copies that reached a solver iteration limit since the last call."""
        shares = [copies.diagnostics()["solver_limit_share"] for copies in self._copies.values()]
        return {"fd_solver_limit_share": max(shares, default=0.0)}

    def _inputs(self, saved: tuple[Tensor, ...]) -> tuple[dict[str, Tensor], Tensor]:
        """The inputs of a saved step by name, each (W, n), and qpos after the step."""
        *state, qpos_end = saved[:5]
        forces = zip((_QFRC, _XFRC), (force.flatten(1) for force in saved[5:]), strict=False)
        return dict(zip(("ctrl", *StepState._fields), state, strict=True)) | dict(forces), qpos_end

    def _columns(self, names: Iterable[str]) -> list[tuple[str, int]]:
        """(input, entry) of each perturbation."""
        return [(name, i) for name in names for i in range(self._sizes[name])]

    def _derivatives(self, columns: list[tuple[str, int]], inputs: dict[str, Tensor]) -> Iterator[tuple[range, Tensor]]:
        """Derivatives of the state after the step along each of `columns`, (chunk, W, S), chunk by chunk."""
        width = max(1, min(len(columns), self.max_worlds // (2 * self._batch.nworld)))
        for first in range(0, len(columns), width):
            chunk = columns[first : first + width]
            yield range(first, first + len(chunk)), self._changes(chunk, width, inputs)

    def _changes(self, chunk: list[tuple[str, int]], width: int, inputs: dict[str, Tensor]) -> Tensor:
        """Derivatives of the state after the step along each column of `chunk`, (len(chunk), W, S)."""
        copies = self._copies.get(width)
        if copies is None:
            copies = self._copies[width] = Stepper(self._batch.resized(2 * width * self._batch.nworld))
        shape = (2, width, self._batch.nworld)
        spread = {name: value.expand(*shape, -1).clone() for name, value in inputs.items()}
        deltas = torch.zeros((*shape, self._tangent.nv), device=self._device)
        steps = torch.ones(len(chunk), 1, 1, device=self._device)
        for k, (name, i) in enumerate(chunk):
            target = deltas if name == "qpos" else spread[name]
            eps = self.eps[name] if name in self.eps else self.eps_applied * self._weight
            target[0, k, :, i] += eps
            target[1, k, :, i] -= eps
            steps[k] = 2.0 * eps
        if any(name == "qpos" for name, _ in chunk):
            spread["qpos"] = self._tangent.integrate(spread["qpos"], deltas)
        ctrl, qpos, qvel, act, *forces = (value.flatten(0, 2) for value in spread.values())
        applied = ExternalForces(forces[0], forces[1].unflatten(-1, (-1, 6))) if forces else None
        end = copies.step(ctrl, StepState(qpos, qvel, act), applied)
        copies.engine.settle()
        ends = [value.view(*shape, -1)[:, : len(chunk)] for value in end]
        changes = [self._tangent.difference(ends[0][1], ends[0][0]), *(e[0] - e[1] for e in ends[1:])]
        return torch.cat(changes, dim=-1) / steps
