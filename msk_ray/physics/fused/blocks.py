"""Dense linear algebra of one thread, in blocks of 4 × 4 that stay in registers.

Matrices are row by row, `width` numbers a row, and vectors have as many; `width` is a multiple of 4. All are rows of
arrays (W, ...), one for each world.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def four(values: wp.array2d[float], world: int, k: int) -> wp.vec4:
    """Numbers k to k + 3 of a world."""
    return wp.vec4(values[world, k], values[world, k + 1], values[world, k + 2], values[world, k + 3])


@wp.func
def put_four(values: wp.array2d[float], world: int, k: int, v: wp.vec4) -> None:
    values[world, k] = v[0]
    values[world, k + 1] = v[1]
    values[world, k + 2] = v[2]
    values[world, k + 3] = v[3]


@wp.func
def block(matrix: wp.array2d[float], world: int, start: int, width: int) -> wp.mat44:
    """The block whose first number is at `start`."""
    return wp.matrix_from_rows(
        four(matrix, world, start),
        four(matrix, world, start + width),
        four(matrix, world, start + 2 * width),
        four(matrix, world, start + 3 * width),
    )


@wp.func
def put_block(matrix: wp.array2d[float], world: int, start: int, width: int, a: wp.mat44) -> None:
    for i in range(4):
        put_four(matrix, world, start + i * width, a[i])


@wp.func
def row_product(matrix: wp.array2d[float], world: int, start: int, vector: wp.array2d[float], width: int) -> float:
    """A row of a matrix, from `start` on, times a vector."""
    total = float(0.0)
    for k in range(0, width, 4):
        total += wp.dot(four(matrix, world, start + k), four(vector, world, k))
    return total


@wp.func
def multiply(
    matrix: wp.array2d[float], world: int, vector: wp.array2d[float], width: int, product: wp.array2d[float]
) -> None:
    """product = matrix vector."""
    for k in range(0, width, 4):
        total = wp.vec4(0.0)
        for j in range(0, width, 4):
            total += block(matrix, world, k * width + j, width) @ four(vector, world, j)
        put_four(product, world, k, total)


@wp.func
def factor_block(a: wp.mat44) -> wp.mat44:
    """L with a = L Lᵀ, of the lower triangle of `a`; on its diagonal are the reciprocals, 1 / Lᵢᵢ."""
    d0 = 1.0 / wp.sqrt(a[0, 0])
    l10 = a[1, 0] * d0
    l20 = a[2, 0] * d0
    l30 = a[3, 0] * d0
    d1 = 1.0 / wp.sqrt(a[1, 1] - l10 * l10)
    l21 = (a[2, 1] - l20 * l10) * d1
    l31 = (a[3, 1] - l30 * l10) * d1
    d2 = 1.0 / wp.sqrt(a[2, 2] - l20 * l20 - l21 * l21)
    l32 = (a[3, 2] - l30 * l20 - l31 * l21) * d2
    d3 = 1.0 / wp.sqrt(a[3, 3] - l30 * l30 - l31 * l31 - l32 * l32)
    return wp.mat44(d0, 0.0, 0.0, 0.0, l10, d1, 0.0, 0.0, l20, l21, d2, 0.0, l30, l31, l32, d3)


@wp.func
def forward(factor: wp.mat44, v: wp.vec4) -> wp.vec4:
    """x with L x = v."""
    x0 = v[0] * factor[0, 0]
    x1 = (v[1] - factor[1, 0] * x0) * factor[1, 1]
    x2 = (v[2] - factor[2, 0] * x0 - factor[2, 1] * x1) * factor[2, 2]
    x3 = (v[3] - factor[3, 0] * x0 - factor[3, 1] * x1 - factor[3, 2] * x2) * factor[3, 3]
    return wp.vec4(x0, x1, x2, x3)


@wp.func
def backward(factor: wp.mat44, v: wp.vec4) -> wp.vec4:
    """x with Lᵀ x = v."""
    x3 = v[3] * factor[3, 3]
    x2 = (v[2] - factor[3, 2] * x3) * factor[2, 2]
    x1 = (v[1] - factor[2, 1] * x2 - factor[3, 1] * x3) * factor[1, 1]
    x0 = (v[0] - factor[1, 0] * x1 - factor[2, 0] * x2 - factor[3, 0] * x3) * factor[0, 0]
    return wp.vec4(x0, x1, x2, x3)


@wp.func
def below(factor: wp.mat44, a: wp.mat44) -> wp.mat44:
    """X with X Lᵀ = a."""
    return wp.matrix_from_rows(
        forward(factor, a[0]), forward(factor, a[1]), forward(factor, a[2]), forward(factor, a[3])
    )


@wp.func
def solve_factored(
    factor: wp.array2d[float], world: int, vector: wp.array2d[float], width: int, solution: wp.array2d[float]
) -> None:
    """solution = -(L Lᵀ)⁻¹ vector, of a factor whose diagonal holds reciprocals."""
    for i in range(0, width, 4):
        v = -four(vector, world, i)
        for k in range(0, i, 4):
            v -= block(factor, world, i * width + k, width) @ four(solution, world, k)
        put_four(solution, world, i, forward(block(factor, world, i * width + i, width), v))
    for back in range(4, width + 4, 4):
        i = width - back
        v = four(solution, world, i)
        for k in range(i + 4, width, 4):
            v -= wp.transpose(block(factor, world, k * width + i, width)) @ four(solution, world, k)
        put_four(solution, world, i, backward(block(factor, world, i * width + i, width), v))
