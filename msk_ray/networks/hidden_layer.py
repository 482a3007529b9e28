"""A hidden layer of several networks, LayerNorm(ELU(x Wᵀ + b)): after the product, one kernel forward and two back.

Torch has four kernels for each network forward and nine back, of which the sums over rows, for the gradients of biases
and of the norm's parameters, take most of the time of a fit of many rows. Axes: C networks, N rows of each, I inputs,
F features. Kernels take the rows of all networks, one network after the other.
"""

import math
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from msk_ray.step.autograd.buffers import stream_of
from msk_ray.step.forward.fused.lanes import WARP, lane_count, lane_sum

_BLOCK = 128
"""Threads of a block: neighbouring features, or the warps of a few rows."""
_CHUNK = 32
"""Rows that a thread adds up. Sums of chunks are added by torch, so that their order is fixed."""
_PARTS = 8
"""Parts of the rows whose products for a weight's gradient are separate, because a product of many rows but few inputs
and features fills only a little of a GPU."""

wp.set_module_options({"enable_backward": False})


# Unrolled, so that the numbers of several turns are fetched together. What is not a number stays so.
_LOOP = """
#if defined(__CUDA_ARCH__)
    #pragma unroll 4
#endif
    for (int k = lane; k < width; k += step) {
        const float e = x[k] > 0.0f ? x[k] : wp::exp(x[k]) - 1.0f;
"""


@wp.func_native(
    f"""
    const float* __restrict__ x = x_in.data + (size_t)row * width;
    float sum = 0.0f, squares = 0.0f;
    {_LOOP}
        sum += e;
        squares += e * e;
    }}
    return wp::vec_t<2, wp::float32>(sum, squares);
"""
)
def active_sums(x_in: wp.array2d[float], row: int, width: int, lane: int, step: int) -> wp.vec2: ...


@wp.func_native(
    f"""
    const float* __restrict__ x = x_in.data + (size_t)row * width;
    float* __restrict__ y = y_out.data + (size_t)row * width;
    const float* __restrict__ gain = gain_in.data + network * width;
    const float* __restrict__ shift = shift_in.data + network * width;
    {_LOOP}
        y[k] = (e - mean) * scale * gain[k] + shift[k];
    }}
"""
)
def write_norm(
    x_in: wp.array2d[float],
    gain_in: wp.array2d[float],
    shift_in: wp.array2d[float],
    mean: float,
    scale: float,
    network: int,
    row: int,
    width: int,
    lane: int,
    step: int,
    y_out: wp.array2d[float],
) -> None: ...


@wp.func_native(
    f"""
    const float* __restrict__ x = x_in.data + (size_t)row * width;
    const float* __restrict__ bar = bar_in.data + (size_t)row * width;
    const float* __restrict__ gain = gain_in.data + network * width;
    float sum = 0.0f, products = 0.0f;
    {_LOOP}
        const float h_bar = gain[k] * bar[k];
        sum += h_bar;
        products += h_bar * (e - mean) * scale;
    }}
    return wp::vec_t<2, wp::float32>(sum, products);
"""
)
def pulled_sums(
    x_in: wp.array2d[float],
    gain_in: wp.array2d[float],
    bar_in: wp.array2d[float],
    mean: float,
    scale: float,
    network: int,
    row: int,
    width: int,
    lane: int,
    step: int,
) -> wp.vec2: ...


@wp.kernel
def activate(
    # In:
    x_in: wp.array2d[float],
    gain_in: wp.array2d[float],
    shift_in: wp.array2d[float],
    epsilon: float,
    # Out:
    y_out: wp.array2d[float],
    mean_out: wp.array[float],
    scale_out: wp.array[float],
) -> None:
    """y = gain · h + shift, h = (e - mean e) · scale, e = ELU(x); a warp a row."""
    thread = wp.tid()
    row = thread // lane_count()
    lane = thread % lane_count()
    width = x_in.shape[1]
    sums = active_sums(x_in, row, width, lane, lane_count())
    mean = lane_sum(sums[0]) / float(width)
    scale = 1.0 / wp.sqrt(wp.max(lane_sum(sums[1]) / float(width) - mean * mean, 0.0) + epsilon)
    if lane == 0:
        mean_out[row] = mean
        scale_out[row] = scale
    network = row // (x_in.shape[0] // gain_in.shape[0])
    write_norm(x_in, gain_in, shift_in, mean, scale, network, row, width, lane, lane_count(), y_out)


@wp.kernel
def average_rows(
    # In:
    x_in: wp.array2d[float],
    gain_in: wp.array2d[float],
    mean_in: wp.array[float],
    scale_in: wp.array[float],
    bar_in: wp.array2d[float],
    # Out:
    means_out: wp.array2d[float],
) -> None:
    """mean h̄ and mean (h̄ h), h̄ = gain · ȳ; a warp a row."""
    thread = wp.tid()
    row = thread // lane_count()
    lane = thread % lane_count()
    width = x_in.shape[1]
    network = row // (x_in.shape[0] // gain_in.shape[0])
    sums = pulled_sums(x_in, gain_in, bar_in, mean_in[row], scale_in[row], network, row, width, lane, lane_count())
    first = lane_sum(sums[0]) / float(width)
    second = lane_sum(sums[1]) / float(width)
    if lane == 0:
        means_out[row, 0] = first
        means_out[row, 1] = second


@wp.func_native(
    """
    const float* __restrict__ x_in = x.data + k;
    const float* __restrict__ bar_in = bar.data + k;
    const float* __restrict__ means_in = means.data;
    const float* __restrict__ mean_in = mean.data;
    const float* __restrict__ scale_in = scale.data;
    float* __restrict__ x_bar_out = x_bar.data + k;
    float gain_bar = 0.0f, shift_bar = 0.0f, bias_bar = 0.0f;
#if defined(__CUDA_ARCH__)
    #pragma unroll 4
#endif
    for (int row = begin; row < end; ++row) {
        const float value = x_in[(size_t)row * width];
        const float y_bar = bar_in[(size_t)row * width];
        // e to the x where x is negative: ELU's slope, and ELU but for 1.
        const float slope = wp::exp(wp::min(value, 0.0f));
        const float h = (wp::max(value, 0.0f) + slope - 1.0f - mean_in[row]) * scale_in[row];
        const float pulled = slope * scale_in[row] * (gain * y_bar - means_in[2 * row] - h * means_in[2 * row + 1]);
        x_bar_out[(size_t)row * width] = pulled;
        gain_bar += y_bar * h;
        shift_bar += y_bar;
        bias_bar += pulled;
    }
    return wp::vec_t<3, wp::float32>(gain_bar, shift_bar, bias_bar);
"""
)
def pull_column(
    x: wp.array2d[float],
    gain: float,
    mean: wp.array[float],
    scale: wp.array[float],
    bar: wp.array2d[float],
    means: wp.array2d[float],
    begin: int,
    end: int,
    k: int,
    width: int,
    x_bar: wp.array2d[float],
) -> wp.vec3: ...


@wp.kernel
def pull_rows_back(
    # In:
    x_in: wp.array2d[float],
    gain_in: wp.array2d[float],
    mean_in: wp.array[float],
    scale_in: wp.array[float],
    bar_in: wp.array2d[float],
    means_in: wp.array2d[float],
    chunk: int,
    # Out:
    x_bar_out: wp.array2d[float],
    sums_out: wp.array4d[float],
) -> None:
    """x̄ = ELU'(x) · scale · (h̄ - mean h̄ - h · mean (h̄ h)), and Σ ȳ h, Σ ȳ and Σ x̄ over each chunk of a network's rows,
    which is what gain, shift and bias pull back; a thread a feature of a chunk."""
    network, part, k = wp.tid()
    rows = x_in.shape[0] // gain_in.shape[0]
    begin = network * rows + part * chunk
    end = wp.min(begin + chunk, (network + 1) * rows)
    gain = gain_in[network, k]
    sums = pull_column(x_in, gain, mean_in, scale_in, bar_in, means_in, begin, end, k, x_in.shape[1], x_bar_out)
    for i in range(3):
        sums_out[network, part, i, k] = sums[i]


class _HiddenLayer(torch.autograd.Function):
    """(x, weight, bias, gain, shift) to the layer's output (C, N, F), differentiable once in all."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, gain: Tensor, shift: Tensor, epsilon: float
    ) -> Tensor:
        inner = torch.baddbmm(bias[:, None], x, weight.mT)
        out = torch.empty_like(inner)
        mean, scale = inner.new_empty((2, inner[..., 0].numel())).unbind()
        rows = inner.flatten(0, 1)
        _launch(activate, len(rows), (rows, gain, shift), (out.flatten(0, 1), mean, scale), epsilon)
        ctx.save_for_backward(x, weight, inner, gain, mean, scale)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, inner, gain, mean, scale = ctx.saved_tensors
        networks, count, features = inner.shape
        rows, bar = inner.flatten(0, 1), bar.contiguous().flatten(0, 1)
        means = inner.new_empty((len(rows), 2))
        _launch(average_rows, len(rows), (rows, gain, mean, scale, bar), (means,))
        inner_bar = torch.empty_like(inner)
        chunks = -(-count // _CHUNK)
        sums = inner.new_empty((networks, chunks, 3, features))
        outputs = (inner_bar.flatten(0, 1), sums)
        _launch(pull_rows_back, (networks, chunks, features), (rows, gain, mean, scale, bar, means), outputs, _CHUNK)
        gain_bar, shift_bar, bias_bar = sums.sum(1).unbind(1)
        x_bar = inner_bar @ weight if ctx.needs_input_grad[0] else None
        parts = (networks, math.gcd(count, _PARTS), -1)
        products = inner_bar.reshape(*parts, features).mT @ x.reshape(*parts, x.shape[2])
        return x_bar, products.sum(1), bias_bar, gain_bar, shift_bar, None


def hidden_layer(x: Tensor, weight: Tensor, bias: Tensor, gain: Tensor, shift: Tensor, epsilon: float) -> Tensor:
    """LayerNorm(ELU(x Wᵀ + b)) of each network, shape (C, N, F), float32.

    Args:
        x: (C, N, I). weight: (C, F, I). bias: (C, F).
        gain, shift: of the norm, (C, F).
        epsilon: what the norm adds to the variance.
    """
    out: Tensor = _HiddenLayer.apply(x, weight, bias, gain, shift, epsilon)
    return out


def _launch(
    kernel: Any, size: int | tuple[int, ...], inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...], *numbers: float
) -> None:
    """Launch over rows, a warp each, or over (networks, chunks, features), on torch's current stream."""
    wp.init()
    device = inputs[0].device
    arrays = [[wp.from_torch(t.detach(), requires_grad=False) for t in group] for group in (inputs, outputs)]
    wp.launch(
        kernel,
        dim=size * (WARP if device.type == "cuda" else 1) if isinstance(size, int) else size,
        inputs=[*arrays[0], *numbers],
        outputs=arrays[1],
        device=str(device),
        stream=stream_of(device),
        block_dim=_BLOCK,
    )
