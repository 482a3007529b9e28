"""Solves by Cholesky's factors, each written twice: by one block a world for small models, by one thread for others.

A block has its matrices in shared memory. Its factors are upper triangles as in mujoco_warp, and blocks as large: its
device code for a matrix of this size, which takes five seconds to compile, serves here too.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

# Largest nv whose matrices fit the shared memory of one block (two tiles of nv² floats).
TILE_LIMIT = 64
_BLOCK = 32


@wp.func
def _factor(matrix: wp.array2d[float], nv: int) -> None:
    """Cholesky factor in the lower triangle, in place."""
    for j in range(nv):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        pivot = wp.sqrt(pivot)
        matrix[j, j] = pivot
        for i in range(j + 1, nv):
            entry = matrix[i, j]
            for k in range(j):
                entry -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = entry / pivot


@wp.func
def _substitute(factor: wp.array2d[float], nv: int, x: wp.array[float]) -> None:
    """L Lᵀ x = x, in place."""
    for i in range(nv):
        entry = x[i]
        for k in range(i):
            entry -= factor[i, k] * x[k]
        x[i] = entry / factor[i, i]
    for s in range(nv):
        i = nv - 1 - s
        entry = x[i]
        for k in range(i + 1, nv):
            entry -= factor[k, i] * x[k]
        x[i] = entry / factor[i, i]


@cache
def both_tiled(nv: int) -> Any:
    """μ, a - â and λ of a world from M + hB, whose hB is diagonal, and H; in one block, for nv up to TILE_LIMIT."""

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(
        # In:
        implicit_in: wp.array3d[float],
        hessian_in: wp.array3d[float],
        rhs_in: wp.array2d[float],
        damping_step_in: wp.array2d[float],
        qacc_in: wp.array2d[float],
        # Out:
        mu_out: wp.array2d[float],
        excess_out: wp.array2d[float],
        lam_out: wp.array2d[float],
    ) -> None:
        worldid = wp.tid()
        rhs = wp.tile_load(rhs_in[worldid], shape=wp.static(nv))
        step = wp.tile_load(damping_step_in[worldid], shape=wp.static(nv))
        qacc = wp.tile_load(qacc_in[worldid], shape=wp.static(nv))
        implicit = wp.tile_load(implicit_in[worldid], shape=(wp.static(nv), wp.static(nv)))
        wp.tile_cholesky_inplace(implicit, fill_mode="upper")
        # (M + hB) μ = h v̄'
        mu = wp.tile_cholesky_solve(implicit, rhs, fill_mode="upper")
        wp.tile_store(mu_out[worldid], mu)
        # â = (M + hB)⁻¹ M a  ⇒  a - â = (M + hB)⁻¹ hB a
        push = wp.tile_map(wp.mul, step, qacc)
        wp.tile_store(excess_out[worldid], wp.tile_cholesky_solve(implicit, push, fill_mode="upper"))
        # M μ = h v̄' - hB μ ,  H λ = M μ
        rest = wp.tile_map(wp.sub, rhs, wp.tile_map(wp.mul, step, mu))
        hessian = wp.tile_load(hessian_in[worldid], shape=(wp.static(nv), wp.static(nv)))
        wp.tile_cholesky_inplace(hessian, fill_mode="upper")
        wp.tile_store(lam_out[worldid], wp.tile_cholesky_solve(hessian, rest, fill_mode="upper"))

    return kernel


@wp.kernel
def both_serial(
    # Model:
    nv: int,
    # In:
    implicit_in: wp.array3d[float],
    hessian_in: wp.array3d[float],
    rhs_in: wp.array2d[float],
    damping_step_in: wp.array2d[float],
    qacc_in: wp.array2d[float],
    # Out:
    mu_out: wp.array2d[float],
    excess_out: wp.array2d[float],
    lam_out: wp.array2d[float],
) -> None:
    """As `both_tiled`, for any nv, one thread a world; factors overwrite the matrices."""
    worldid = wp.tid()
    _factor(implicit_in[worldid], nv)
    for i in range(nv):
        mu_out[worldid, i] = rhs_in[worldid, i]
        excess_out[worldid, i] = damping_step_in[worldid, i] * qacc_in[worldid, i]
    _substitute(implicit_in[worldid], nv, mu_out[worldid])
    _substitute(implicit_in[worldid], nv, excess_out[worldid])
    for i in range(nv):
        lam_out[worldid, i] = rhs_in[worldid, i] - damping_step_in[worldid, i] * mu_out[worldid, i]
    _factor(hessian_in[worldid], nv)
    _substitute(hessian_in[worldid], nv, lam_out[worldid])


@cache
def one_tiled(nv: int, has_second: bool) -> Any:
    """A⁻¹ of one right-hand side or of a second as well, for nv up to TILE_LIMIT."""

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(
        # In:
        matrix_in: wp.array3d[float],
        first_in: wp.array2d[float],
        second_in: wp.array2d[float],
        # Out:
        first_out: wp.array2d[float],
        second_out: wp.array2d[float],
    ) -> None:
        worldid = wp.tid()
        matrix = wp.tile_load(matrix_in[worldid], shape=(wp.static(nv), wp.static(nv)))
        wp.tile_cholesky_inplace(matrix, fill_mode="upper")
        first = wp.tile_load(first_in[worldid], shape=wp.static(nv))
        wp.tile_store(first_out[worldid], wp.tile_cholesky_solve(matrix, first, fill_mode="upper"))
        if wp.static(has_second):
            other = wp.tile_load(second_in[worldid], shape=wp.static(nv))
            wp.tile_store(second_out[worldid], wp.tile_cholesky_solve(matrix, other, fill_mode="upper"))

    return kernel


@wp.kernel
def one_serial(
    # Model:
    nv: int,
    has_second: bool,
    # In:
    matrix_in: wp.array3d[float],
    first_in: wp.array2d[float],
    second_in: wp.array2d[float],
    # Out:
    first_out: wp.array2d[float],
    second_out: wp.array2d[float],
) -> None:
    """As `one_tiled`, for any nv, one thread a world; the factor overwrites the matrix."""
    worldid = wp.tid()
    _factor(matrix_in[worldid], nv)
    for i in range(nv):
        first_out[worldid, i] = first_in[worldid, i]
    _substitute(matrix_in[worldid], nv, first_out[worldid])
    if has_second:
        for i in range(nv):
            second_out[worldid, i] = second_in[worldid, i]
        _substitute(matrix_in[worldid], nv, second_out[worldid])


def solve_both(inputs: Sequence[wp.array], outputs: Sequence[wp.array]) -> None:
    """Launch both systems of a substep where B is diagonal.

    Args:
        inputs: M + hB, H, h v̄', the diagonal hB and a.
        outputs: μ, a - â and λ.
    """
    worlds, nv = inputs[2].shape
    if nv <= TILE_LIMIT:
        wp.launch_tiled(both_tiled(nv), dim=worlds, inputs=inputs, outputs=outputs, block_dim=_BLOCK)
    else:
        wp.launch(both_serial, dim=worlds, inputs=[nv, *inputs], outputs=outputs)


def solve_one(matrix: wp.array, sides: Sequence[wp.array], outputs: Sequence[wp.array]) -> None:
    """Launch one system with one or two right-hand sides, (W, nv)."""
    worlds, nv = sides[0].shape
    has_second = len(sides) == 2
    inputs, outputs = [matrix, sides[0], sides[-1]], [outputs[0], outputs[-1]]
    if nv <= TILE_LIMIT:
        wp.launch_tiled(one_tiled(nv, has_second), dim=worlds, inputs=inputs, outputs=outputs, block_dim=_BLOCK)
    else:
        wp.launch(one_serial, dim=worlds, inputs=[nv, has_second, *inputs], outputs=outputs)
