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


# A block of 4 x 4 entries takes two loads a row, as many as one entry alone would. Two lanes share a block: one adds up
# the even rows, the other the odd ones.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int parts = 2;
#else
    const int parts = 1;
#endif
    const int blocks = width / 4 * (width / 4 + 1) / 2;
    for (int base = 0; base < parts * blocks; base += lanes) {
        const int block = (base + lane) / parts;
        float total[4][4] = {};
        int above = 0;
        while ((above + 1) * (above + 2) / 2 <= block)
            ++above;
        const int i = 4 * above;
        const int j = 4 * (block - above * (above + 1) / 2);
        if (block < blocks) {
            for (int k = lane % parts; k < count; k += parts) {
                const float w = weight.data[k];
#if defined(__CUDA_ARCH__)
                const float4 a = *reinterpret_cast<const float4*>(rows.data + k * stride + i);
                const float4 b = *reinterpret_cast<const float4*>(rows.data + k * stride + j);
                const float left[4] = {w * a.x, w * a.y, w * a.z, w * a.w};
                const float right[4] = {b.x, b.y, b.z, b.w};
#else
                const float* a = rows.data + k * stride + i;
                const float* right = rows.data + k * stride + j;
                const float left[4] = {w * a[0], w * a[1], w * a[2], w * a[3]};
#endif
                for (int p = 0; p < 4; ++p)
                    for (int q = 0; q < 4; ++q)
                        total[p][q] += left[p] * right[q];
            }
        }
#if defined(__CUDA_ARCH__)
        for (int p = 0; p < 4; ++p)
            for (int q = 0; q < 4; ++q)
                total[p][q] += __shfl_xor_sync(0xffffffffu, total[p][q], 1);
#endif
        if (block < blocks) {
            for (int q = 0; q < 4; ++q)
                if (q % parts == lane % parts)
                    for (int p = 0; p < 4; ++p) {
                        const int entry = (j + q) * width + i + p;
                        product.data[entry] = start.data[entry] + total[p][q];
                    }
        }
    }
""")
def add_squares(
    start: wp.array[float],
    weight: wp.array[float],
    rows: wp.array[float],
    count: int,
    stride: int,
    width: int,
    lane: int,
    lanes: int,
    product: wp.array[float],
) -> None:
    """product = start + Σ weight · row rowᵀ over `count` rows, whose first numbers are `stride` apart: blocks of 4 x 4
    entries on and below the diagonal."""


@wp.func
def factorize(matrix: wp.array[float], pivot: wp.array[float], size: int, width: int, lane: int) -> None:
    """Factor a lower triangle in place into L D of L D Lᵀ, with 1 / D; NaN where D is not positive. The upper triangle
    becomes its mirror image."""
    for j in range(size):
        for i in range(j + lane, size, lane_count()):
            value = at(matrix, j * width + i) - pair_sum(pivot, matrix, i, j, width, j)
            put(matrix, j * width + i, value)
            put(matrix, i * width + j, value)
            if i == j:
                put(pivot, j, wp.where(value > 0.0, 1.0 / value, _NAN))
        lane_sync()


# On a GPU, each lane keeps its two numbers of the solution in registers.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int other = lane + 32;
    float y = lane < size ? solution.data[lane] : 0.0f;
    float z = other < size ? solution.data[other] : 0.0f;
    #pragma unroll 4
    for (int k = 0; k < size; ++k) {
        const float value = __shfl_sync(0xffffffffu, k < 32 ? y : z, k & 31) * pivot.data[k];
        if (lane > k && lane < size)
            y -= factor.data[k * width + lane] * value;
        if (other > k && other < size)
            z -= factor.data[k * width + other] * value;
    }
    #pragma unroll 4
    for (int k = size - 1; k >= 0; --k) {
        const float value = __shfl_sync(0xffffffffu, k < 32 ? y : z, k & 31) * pivot.data[k];
        if (lane == k)
            y = value;
        if (other == k)
            z = value;
        if (lane < k)
            y -= factor.data[k * width + lane] * value;
        if (other < k)
            z -= factor.data[k * width + other] * value;
    }
    if (lane < size)
        solution.data[lane] = y;
    if (other < size)
        solution.data[other] = z;
#else
    for (int k = 0; k < size; ++k) {
        const float value = solution.data[k] * pivot.data[k];
        for (int i = k + 1; i < size; ++i)
            solution.data[i] -= factor.data[k * width + i] * value;
    }
    for (int k = size - 1; k >= 0; --k) {
        const float value = solution.data[k] *= pivot.data[k];
        for (int i = 0; i < k; ++i)
            solution.data[i] -= factor.data[k * width + i] * value;
    }
#endif
""")
def solve_factored(
    factor: wp.array[float], pivot: wp.array[float], size: int, width: int, lane: int, solution: wp.array[float]
) -> None:
    """Replace `solution`, of up to 64 numbers, by (L D Lᵀ)⁻¹ solution; each lane reads what it wrote itself."""
