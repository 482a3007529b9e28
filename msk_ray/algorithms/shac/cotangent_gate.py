"""The gate between env steps in the backward pass: it bounds and measures each world's state cotangent."""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from msk_ray.envs import EnvState
from msk_ray.group import ALONE, Group
from msk_ray.step import StepState


class Norms(NamedTuple):
    """Statistics of the norms of finite state cotangents; scalars, still on the device."""

    median: Tensor
    p90: Tensor
    """90th percentile."""
    maximum: Tensor
    clipped_share: Tensor
    """Share of all cotangents above the bound."""


class CotangentStatistics(NamedTuple):
    """A summary of what a gate measured in one backward pass."""

    nonfinite_share: Tensor
    """Share of worlds with a cotangent that was not finite, a scalar on the device."""
    norms: Norms | None
    """None if no cotangent was finite."""

    def metrics(self) -> dict[str, Tensor]:
        """The same values by metric name."""
        shares = {"grad/nonfinite_share": self.nonfinite_share}
        if self.norms is None:
            return shares
        return {
            "grad/state_median": self.norms.median,
            "grad/state_p90": self.norms.p90,
            "grad/state_max": self.norms.maximum,
            "grad/clipped_share": self.norms.clipped_share,
            **shares,
        }


class CotangentRecord(NamedTuple):
    """What a gate measured in one backward pass, on the device."""

    nonfinite_share: Tensor
    """Share of worlds with a cotangent that was not finite, a scalar."""
    lengths: Tensor
    """Norms of all state cotangents, (N,)."""
    bound: float | None
    """Largest norm let through."""

    def statistics(self, unit: float) -> CotangentStatistics:
        """Norms in units of `unit`, over worlds and steps; waits for the device."""
        finite = self.lengths[self.lengths.isfinite()]
        if not finite.numel():
            return CotangentStatistics(self.nonfinite_share, None)
        median, p90 = torch.quantile(finite, torch.tensor([0.5, 0.9], device=finite.device)) / unit
        clipped = finite.new_zeros(()) if self.bound is None else (self.lengths > self.bound).float().mean()
        return CotangentStatistics(self.nonfinite_share, Norms(median, p90, finite.max() / unit, clipped_share=clipped))


class CotangentGate:
    """Bounds each world's state cotangent and measures it in one backward pass.

    Without a bound, a few worlds with exploding cotangents would dominate the policy gradient. The bound keeps the
    direction. A world with a non-finite cotangent passes nothing back, and is counted.

    Args:
        bound: largest norm let through; None for no bound.
        nworld: number of worlds W.
    """

    def __init__(self, bound: float | None, nworld: int, device: torch.device) -> None:
        self.bound = bound
        self._largest = torch.finfo(torch.float32).max if bound is None else bound
        """Largest norm that passes unchanged."""
        self._norms: list[Tensor] = []
        self._nonfinite = torch.zeros(nworld, dtype=torch.bool, device=device)

    def __call__(self, state: EnvState) -> EnvState:
        """The same state, where the cotangent of physics and memories passes the gate in the backward pass."""
        memory = {name: values for name, values in state.memory.items() if values.requires_grad}
        parts = (*state.physics, *memory.values())
        if not any(t.requires_grad for t in parts):
            return state
        qpos, qvel, act, *others = _Gate.apply(self, *parts)
        return state._replace(
            physics=StepState(qpos, qvel, act), memory={**state.memory, **dict(zip(memory, others, strict=True))}
        )

    def screen(self, action: Tensor) -> Tensor:
        """The same actions (W, A); in the backward pass, non-finite cotangents are stopped and counted.

        Needed besides `state`: derivatives that overflow inside a step spoil the controls' cotangent too.
        """
        return _Screen.apply(self, action) if action.requires_grad else action

    def pull_screened(self, cotangent: Tensor) -> Tensor:
        """The cotangent (W, A) let through."""
        if cotangent.device.type == "cpu" and cotangent.sum().isfinite():
            return cotangent
        finite = cotangent.isfinite().all(-1)
        self._nonfinite |= ~finite
        return cotangent.masked_fill(~finite[:, None], 0.0)

    def pull(self, cotangent: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """The cotangents let through, each (W, n)."""
        whole = torch.cat(cotangent, dim=-1)
        norm = torch.linalg.vector_norm(whole, dim=-1)
        self._norms.append(norm)
        if norm.device.type == "cpu" and norm.max() <= self._largest:
            return cotangent
        lost = ~norm.isfinite()
        self._nonfinite |= lost
        if self.bound is not None:
            whole = (self.bound / norm).clamp(max=1.0)[:, None] * whole
        return whole.masked_fill(lost[:, None], 0.0).split([g.shape[-1] for g in cotangent], dim=-1)

    def record(self, group: Group = ALONE) -> CotangentRecord:
        """The statistics of this backward pass, over the worlds of all processes."""
        lengths = group.gather(torch.cat(self._norms)) if self._norms else torch.zeros(0, device=self._nonfinite.device)
        nonfinite_share = self._nonfinite.float().mean()
        group.mean([nonfinite_share])
        return CotangentRecord(nonfinite_share, lengths, self.bound)


class _Gate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gate: CotangentGate, *state: Tensor) -> tuple[Tensor, ...]:
        ctx.gate = gate
        return tuple(t.view_as(t) for t in state)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangent: Tensor) -> tuple[Tensor | None, ...]:
        return (None, *ctx.gate.pull(cotangent))


class _Screen(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gate: CotangentGate, action: Tensor) -> Tensor:
        ctx.gate = gate
        return action.view_as(action)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        return None, ctx.gate.pull_screened(cotangent)
