"""Dense linear algebra by the lanes of a world. Matrices are column-major, with `width` numbers per column."""

import warp as wp

wp.set_module_options({"enable_backward": False})


# On a GPU, each lane adds up its two numbers together, and several terms are loaded at once.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int other = lane + 32;
    float y = 0.0f;
    float z = 0.0f;
    #pragma unroll 4
    for (int k = 0; k < count; ++k) {
        const float w = weight.data[k];
        if (lane < size)
            y += w * matrix.data[k * width + lane];
        if (other < size)
            z += w * matrix.data[k * width + other];
    }
    if (lane < size)
        product.data[lane] = y;
    if (other < size)
        product.data[other] = z;
    __syncwarp();
#else
    for (int i = 0; i < size; ++i) {
        float total = 0.0f;
        for (int k = 0; k < count; ++k)
            total += weight.data[k] * matrix.data[k * width + i];
        product.data[i] = total;
    }
#endif
""")
def combine(
    weight: wp.array[float],
    matrix: wp.array[float],
    size: int,
    width: int,
    count: int,
    lane: int,
    product: wp.array[float],
) -> None:
    """product = Σ weight · column over `count` columns of `size` numbers, up to 64."""


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
#if defined(__CUDA_ARCH__)
            #pragma unroll 2
#endif
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


# On a GPU, four columns at a time, of which each lane keeps a row in registers: one round of loads serves four columns.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int j = 0; j < size; j += 4) {
        float inverse[4];
        float across[4][4];
        for (int base = j; base < size; base += 32) {
            const int i = base + lane;
            const int row = i < size ? i : size - 1;
            float v[4];
            for (int q = 0; q < 4; ++q)
                v[q] = matrix.data[(j + q) * width + row];
            #pragma unroll 4
            for (int k = 0; k < j; ++k) {
                const float left = matrix.data[k * width + row] * pivot.data[k];
                const float4 right = *reinterpret_cast<const float4*>(matrix.data + k * width + j);
                v[0] -= left * right.x;
                v[1] -= left * right.y;
                v[2] -= left * right.z;
                v[3] -= left * right.w;
            }
            #pragma unroll
            for (int q = 0; q < 4; ++q) {
                if (base == j) {
                    const float value = __shfl_sync(0xffffffffu, v[q], q);
                    inverse[q] = value > 0.0f ? 1.0f / value : nan;
                    #pragma unroll
                    for (int r = q + 1; r < 4; ++r)
                        across[q][r] = __shfl_sync(0xffffffffu, v[q], r);
                }
                #pragma unroll
                for (int r = q + 1; r < 4; ++r)
                    v[r] -= v[q] * inverse[q] * across[q][r];
            }
            if (i < size) {
                #pragma unroll
                for (int q = 0; q < 4; ++q)
                    if (i >= j + q) {
                        matrix.data[(j + q) * width + i] = v[q];
                        matrix.data[i * width + j + q] = v[q];
                    }
            }
        }
        #pragma unroll
        for (int q = 0; q < 4; ++q)
            if (lane == q && j + q < size)
                pivot.data[j + q] = inverse[q];
        __syncwarp();
    }
#else
    for (int j = 0; j < size; ++j)
        for (int i = j; i < size; ++i) {
            float value = matrix.data[j * width + i];
            for (int k = 0; k < j; ++k)
                value -= matrix.data[k * width + i] * pivot.data[k] * matrix.data[k * width + j];
            matrix.data[j * width + i] = value;
            matrix.data[i * width + j] = value;
            if (i == j)
                pivot.data[j] = value > 0.0f ? 1.0f / value : nan;
        }
#endif
""")
def factorize(matrix: wp.array[float], pivot: wp.array[float], size: int, width: int, lane: int, nan: float) -> None:
    """Factor a lower triangle in place into L D of L D Lᵀ, with 1 / D; `nan` where D is not positive. The upper
    triangle becomes its mirror image."""


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
