"""Dense linear algebra of one thread, in blocks of 4 × 4 that stay in registers.

A vector has `blocks` parts of 4 numbers. A matrix has as many in each row, row by row. Both are rows of arrays of vec4
(W, ...), one for each world.
"""

import warp as wp

from msk_ray.physics.fused.memory import four, put_four

wp.set_module_options({"enable_backward": False})


@wp.func
def block(matrix: wp.array2d[wp.vec4], world: int, i: int, j: int, blocks: int) -> wp.mat44:
    """Block (i, j)."""
    start = 4 * i * blocks + j
    return wp.matrix_from_rows(
        four(matrix, world, start),
        four(matrix, world, start + blocks),
        four(matrix, world, start + 2 * blocks),
        four(matrix, world, start + 3 * blocks),
    )


@wp.func
def put_block(matrix: wp.array2d[wp.vec4], world: int, i: int, j: int, blocks: int, a: wp.mat44) -> None:
    start = 4 * i * blocks + j
    for k in range(4):
        put_four(matrix, world, start + k * blocks, a[k])


@wp.func
def multiply(
    matrix: wp.array2d[wp.vec4],
    world: int,
    vector: wp.array2d[wp.vec4],
    blocks: int,
    product: wp.array2d[wp.vec4],
) -> None:
    """product = matrix vector."""
    for i in range(blocks):
        total = wp.vec4(0.0)
        for j in range(blocks):
            total += block(matrix, world, i, j, blocks) @ four(vector, world, j)
        put_four(product, world, i, total)


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
    factor: wp.array2d[wp.vec4],
    world: int,
    vector: wp.array2d[wp.vec4],
    blocks: int,
    solution: wp.array2d[wp.vec4],
) -> None:
    """solution = -(L Lᵀ)⁻¹ vector, of a factor whose diagonal holds reciprocals."""
    for i in range(blocks):
        v = -four(vector, world, i)
        for k in range(i):
            v -= block(factor, world, i, k, blocks) @ four(solution, world, k)
        put_four(solution, world, i, forward(block(factor, world, i, i, blocks), v))
    for back in range(blocks):
        i = blocks - 1 - back
        v = four(solution, world, i)
        for k in range(i + 1, blocks):
            v -= wp.transpose(block(factor, world, k, i, blocks)) @ four(solution, world, k)
        put_four(solution, world, i, backward(block(factor, world, i, i, blocks), v))
