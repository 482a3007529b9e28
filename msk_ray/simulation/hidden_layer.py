"""A hidden layer, LayerNorm(ELU(x Wᵀ + b)), whose steps after the product are one kernel forward and two back.

Torch has four kernels for them forward and nine back, of which the sums over rows, for the gradients of biases and of
the norm's parameters, take most of the time of a fit of many rows. Axes: N rows, F features.
"""

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from msk_ray.simulation.buffers import stream_of

_LANES = 32
"""Threads that share a row: one warp, whose sums do not wait for others."""
_BLOCK = 128
"""Threads of a block of neighbouring features."""
_CHUNK = 32
"""Rows that a thread adds up. Sums of chunks are added by torch, so that their order is fixed."""

wp.set_module_options({"enable_backward": False})


@wp.func
def elu(x: float) -> float:
    """x, or exp(x) - 1 where it is negative."""
    return wp.where(x > 0.0, x, wp.exp(wp.min(x, 0.0)) - 1.0)


@wp.kernel
def activate(
    # In:
    x_in: wp.array2d[float],
    gain_in: wp.array[float],
    shift_in: wp.array[float],
    epsilon: float,
    # Out:
    y_out: wp.array2d[float],
    mean_out: wp.array[float],
    scale_out: wp.array[float],
) -> None:
    """y = gain · h + shift, h = (e - mean e) · scale, e = ELU(x); a block a row."""
    row, lane = wp.tid()
    width = x_in.shape[1]
    sums = wp.vec2(0.0, 0.0)
    for k in range(lane, width, wp.block_dim()):
        e = elu(x_in[row, k])
        sums += wp.vec2(e, e * e)
    total = wp.tile_reduce(wp.add, wp.tile(sums, preserve_type=True))[0]
    mean = total[0] / float(width)
    scale = 1.0 / wp.sqrt(wp.max(total[1] / float(width) - mean * mean, 0.0) + epsilon)
    if lane == 0:
        mean_out[row] = mean
        scale_out[row] = scale
    for k in range(lane, width, wp.block_dim()):
        y_out[row, k] = (elu(x_in[row, k]) - mean) * scale * gain_in[k] + shift_in[k]


@wp.kernel
def average_rows(
    # In:
    x_in: wp.array2d[float],
    gain_in: wp.array[float],
    mean_in: wp.array[float],
    scale_in: wp.array[float],
    bar_in: wp.array2d[float],
    # Out:
    means_out: wp.array2d[float],
) -> None:
    """mean h̄ and mean (h̄ h), h̄ = gain · ȳ; a block a row."""
    row, lane = wp.tid()
    width = x_in.shape[1]
    mean = mean_in[row]
    scale = scale_in[row]
    sums = wp.vec2(0.0, 0.0)
    for k in range(lane, width, wp.block_dim()):
        h_bar = gain_in[k] * bar_in[row, k]
        sums += wp.vec2(h_bar, h_bar * (elu(x_in[row, k]) - mean) * scale)
    total = wp.tile_reduce(wp.add, wp.tile(sums, preserve_type=True))[0]
    if lane == 0:
        means_out[row, 0] = total[0] / float(width)
        means_out[row, 1] = total[1] / float(width)


@wp.kernel
def pull_rows_back(
    # In:
    x_in: wp.array2d[float],
    gain_in: wp.array[float],
    mean_in: wp.array[float],
    scale_in: wp.array[float],
    bar_in: wp.array2d[float],
    means_in: wp.array2d[float],
    chunk: int,
    # Out:
    x_bar_out: wp.array2d[float],
    sums_out: wp.array3d[float],
) -> None:
    """x̄ = ELU'(x) · scale · (h̄ - mean h̄ - h · mean (h̄ h)), and Σ ȳ h, Σ ȳ and Σ x̄ over each chunk of rows, which is
    what gain, shift and bias pull back; a thread a feature of a chunk."""
    part, k = wp.tid()
    gain = gain_in[k]
    gain_bar = float(0.0)
    shift_bar = float(0.0)
    bias_bar = float(0.0)
    for row in range(part * chunk, wp.min((part + 1) * chunk, x_in.shape[0])):
        x = x_in[row, k]
        bar = bar_in[row, k]
        scale = scale_in[row]
        # e to the x where x is negative: ELU's slope, and ELU but for 1.
        slope = wp.exp(wp.min(x, 0.0))
        h = (wp.max(x, 0.0) + slope - 1.0 - mean_in[row]) * scale
        x_bar = slope * scale * (gain * bar - means_in[row, 0] - h * means_in[row, 1])
        x_bar_out[row, k] = x_bar
        gain_bar += bar * h
        shift_bar += bar
        bias_bar += x_bar
    sums_out[part, 0, k] = gain_bar
    sums_out[part, 1, k] = shift_bar
    sums_out[part, 2, k] = bias_bar


class _HiddenLayer(torch.autograd.Function):
    """(x, weight, bias, gain, shift) to the layer's output (N, F), differentiable once in all."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, gain: Tensor, shift: Tensor, epsilon: float
    ) -> Tensor:
        inner = torch.addmm(bias, x, weight.t())
        out = torch.empty_like(inner)
        mean, scale = inner.new_empty((2, len(inner))).unbind()
        _launch(activate, len(inner), (inner, gain, shift), (out, mean, scale), epsilon)
        ctx.save_for_backward(x, weight, inner, gain, mean, scale)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, inner, gain, mean, scale = ctx.saved_tensors
        bar = bar.contiguous()
        means = inner.new_empty((len(inner), 2))
        _launch(average_rows, len(inner), (inner, gain, mean, scale, bar), (means,))
        inner_bar = torch.empty_like(inner)
        parts = -(-len(inner) // _CHUNK)
        sums = inner.new_empty((parts, 3, inner.shape[1]))
        given = (inner, gain, mean, scale, bar, means)
        _launch(pull_rows_back, (parts, inner.shape[1]), given, (inner_bar, sums), _CHUNK)
        gain_bar, shift_bar, bias_bar = sums.sum(0).unbind()
        x_bar = inner_bar @ weight if ctx.needs_input_grad[0] else None
        return x_bar, inner_bar.t() @ x, bias_bar, gain_bar, shift_bar, None


def hidden_layer(x: Tensor, weight: Tensor, bias: Tensor, gain: Tensor, shift: Tensor, epsilon: float) -> Tensor:
    """LayerNorm(ELU(x Wᵀ + b)), shape (N, F), float32.

    Args:
        x: (N, I). weight: (F, I). bias: (F,).
        gain, shift: of the norm, (F,).
        epsilon: what the norm adds to the variance.
    """
    out: Tensor = _HiddenLayer.apply(x, weight, bias, gain, shift, epsilon)
    return out


def _launch(
    kernel: Any, size: int | tuple[int, int], inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...], *numbers: float
) -> None:
    """Launch over rows, a block each, or over (chunks, features), on torch's current stream."""
    wp.init()
    device = inputs[0].device
    arrays = [[wp.from_torch(t.detach(), requires_grad=False) for t in group] for group in (inputs, outputs)]
    rows = isinstance(size, int)
    launch = wp.launch_tiled if rows else wp.launch
    launch(
        kernel,
        dim=size,
        inputs=[*arrays[0], *numbers],
        outputs=arrays[1],
        device=str(device),
        stream=stream_of(device),
        block_dim=_LANES if rows else _BLOCK,
    )
