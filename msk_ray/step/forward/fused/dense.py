"""Dense linear algebra by the lanes of a world. Matrices are column-major, with `width` numbers per column."""

import math

import warp as wp

from msk_ray.step.forward.fused.lanes import at, lane_count, lane_sync, put

wp.set_module_options({"enable_backward": False})

_NAN = wp.constant(math.nan)


# Unrolled, so that several terms are loaded at once.
@wp.func_native("""
    float total = 0.0f;
#if defined(__CUDA_ARCH__)
    #pragma unroll 4
#endif
    for (int k = 0; k < count; ++k)
        total += weight.data[k] * matrix.data[k * width + i];
    return total;
""")
def column_sum(weight: wp.array[float], matrix: wp.array[float], i: int, width: int, count: int) -> float: ...


@wp.func_native("""
    float total = 0.0f;
#if defined(__CUDA_ARCH__)
    #pragma unroll 4
#endif
    for (int k = 0; k < count; ++k)
        total += weight.data[k] * matrix.data[k * width + i] * matrix.data[k * width + j];
    return total;
""")
def pair_sum(weight: wp.array[float], matrix: wp.array[float], i: int, j: int, width: int, count: int) -> float: ...


@wp.func
def multiply(
    matrix: wp.array[float], vector: wp.array[float], size: int, width: int, lane: int, product: wp.array[float]
) -> None:
    """product = matrix vector."""
    for i in range(lane, size, lane_count()):
        put(product, i, column_sum(vector, matrix, i, width, size))
    lane_sync()


@wp.func
def factorize(matrix: wp.array[float], pivot: wp.array[float], size: int, width: int, lane: int) -> None:
    """Factor a lower triangle in place into L D of L D Lᵀ, with 1 / D; NaN where D is not positive."""
    for j in range(size):
        for i in range(j + lane, size, lane_count()):
            value = at(matrix, j * width + i) - pair_sum(pivot, matrix, i, j, width, j)
            put(matrix, j * width + i, value)
            if i == j:
                put(pivot, j, wp.where(value > 0.0, 1.0 / value, _NAN))
        lane_sync()


@wp.func
def solve_factored(
    factor: wp.array[float],
    pivot: wp.array[float],
    size: int,
    width: int,
    lane: int,
    partial: wp.array[float],
    solution: wp.array[float],
) -> None:
    """solution = (L D Lᵀ)⁻¹ partial; overwrites `partial`."""
    for k in range(size):
        value = at(partial, k) * at(pivot, k)
        for i in range(k + 1 + lane, size, lane_count()):
            put(partial, i, at(partial, i) - at(factor, k * width + i) * value)
        lane_sync()
    for back in range(size):
        i = size - 1 - back
        value = at(partial, i) * at(pivot, i)
        if lane == 0:
            put(solution, i, value)
        for k in range(lane, i, lane_count()):
            put(partial, k, at(partial, k) - at(factor, k * width + i) * value)
        lane_sync()
