"""Lengths and rates of tendons as an autograd function of (qpos, qvel)."""

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from msk_ray.step.adjoint.tendon_pullback import TendonAdjoint
from msk_ray.step.autograd.buffers import stream_of
from msk_ray.step.errors import UnsupportedModelError
from msk_ray.step.forward import Graph, WorldBatch


class _TendonState(torch.autograd.Function):
    """(qpos, qvel) to (length, rate), differentiable once in both."""

    @staticmethod
    def forward(ctx: Any, tendons: "Tendons", qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        ctx.tendons = tendons
        ctx.save_for_backward(qpos, qvel)
        return tendons.evaluate(qpos, qvel)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, length_bar: Tensor, rate_bar: Tensor) -> tuple[None, Tensor, Tensor]:
        qpos, qvel = ctx.saved_tensors
        return (None, *ctx.tendons.pull_back(qpos, qvel, length_bar, rate_bar))


class Tendons:
    """Length [m] and rate [m/s] of every tendon of a batch, with exact gradients.

    Shares the batch's `Data`, which every launch overwrites, so it must not run between the launches of a step.

    Raises:
        UnsupportedModelError: the model has no tendons.
    """

    def __init__(self, batch: WorldBatch) -> None:
        if not batch.mjm.ntendon:
            raise UnsupportedModelError("the model has no tendons whose lengths could be observed")
        self._device = torch.device(str(batch.device))
        self._data = batch.data
        self._adjoint = TendonAdjoint(batch.mjm, batch.model, batch.data, batch.stages)
        self._raw = wp.zeros((batch.nworld, batch.mjm.nq), dtype=float, device=batch.device)

        def view(array: wp.array) -> Tensor:
            tensor: Tensor = wp.to_torch(array, requires_grad=False)
            return tensor

        self._qpos, self._qvel = view(batch.data.qpos), view(batch.data.qvel)
        self._length, self._rate = view(batch.data.ten_length), view(self._adjoint.rate)
        self._length_bar, self._rate_bar = view(self._adjoint.length_bar), view(self._adjoint.rate_bar)
        self._grad_qpos, self._grad_qvel = view(self._raw), view(self._adjoint.grad_qvel)
        self._forward = Graph(lambda: self._adjoint.launch_forward(self._data), batch.device)
        self._backward: Graph | None = None
        self._batch_device = batch.device

    def __call__(self, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """Lengths and rates, each (W, ntendon), of states qpos (W, nq) and qvel (W, nv)."""
        if torch.is_grad_enabled() and (qpos.requires_grad or qvel.requires_grad):
            length, rate = _TendonState.apply(self, qpos, qvel)
            return length, rate
        return self.evaluate(qpos, qvel)

    @torch.no_grad()
    def evaluate(self, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """The forward pass alone, outside autograd."""
        self._load(qpos, qvel)
        self._forward.replay(stream_of(self._device))
        return self._length.clone(), self._rate.clone()

    @torch.no_grad()
    def pull_back(self, qpos: Tensor, qvel: Tensor, length_bar: Tensor, rate_bar: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of raw qpos (W, nq) and of qvel (W, nv) for cotangents (W, ntendon)."""
        if self._backward is None:
            self._backward = Graph(self._launch_backward, self._batch_device)
        self._load(qpos, qvel)
        self._length_bar.copy_(length_bar)
        self._rate_bar.copy_(rate_bar)
        self._backward.replay(stream_of(self._device))
        return self._grad_qpos.clone(), self._grad_qvel.clone()

    def _load(self, qpos: Tensor, qvel: Tensor) -> None:
        self._qpos.copy_(qpos)
        self._qvel.copy_(qvel)

    def _launch_backward(self) -> None:
        self._adjoint.launch_pullback(self._data)
        self._adjoint.finish(self._data.qpos, self._raw)
