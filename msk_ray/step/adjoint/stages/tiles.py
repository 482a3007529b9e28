"""The solves of a small model, one block a world, with matrices in the block's shared memory.

Factors are upper triangles as in mujoco_warp, and blocks as large: its device code for a matrix of this size, which
takes five seconds to compile, serves here too.
"""

from functools import cache
from typing import Any

import warp as wp


@cache
def solve_tiled(nv: int) -> Any:
    """Both solves of a world in one block, for nv up to TILE_LIMIT."""

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(
        # In:
        implicit_in: wp.array3d[float],
        hessian_in: wp.array3d[float],
        rhs_in: wp.array2d[float],
        damping_in: wp.array2d[float],
        qacc_in: wp.array2d[float],
        # Out:
        mu_out: wp.array2d[float],
        excess_out: wp.array2d[float],
        lam_out: wp.array2d[float],
    ) -> None:
        worldid = wp.tid()
        rhs = wp.tile_load(rhs_in[worldid], shape=wp.static(nv))
        damping = wp.tile_load(damping_in[worldid], shape=wp.static(nv))
        qacc = wp.tile_load(qacc_in[worldid], shape=wp.static(nv))
        implicit = wp.tile_load(implicit_in[worldid], shape=(wp.static(nv), wp.static(nv)))
        wp.tile_cholesky_inplace(implicit, fill_mode="upper")
        # (M + hB) μ = h v̄'
        mu = wp.tile_cholesky_solve(implicit, rhs, fill_mode="upper")
        wp.tile_store(mu_out[worldid], mu)
        # â = (M + hB)⁻¹ M a  ⇒  a - â = (M + hB)⁻¹ hB a
        push = wp.tile_map(wp.mul, damping, qacc)
        wp.tile_store(excess_out[worldid], wp.tile_cholesky_solve(implicit, push, fill_mode="upper"))
        # M μ = h v̄' - hB μ ,  H λ = M μ
        rest = wp.tile_map(wp.sub, rhs, wp.tile_map(wp.mul, damping, mu))
        hessian = wp.tile_load(hessian_in[worldid], shape=(wp.static(nv), wp.static(nv)))
        wp.tile_cholesky_inplace(hessian, fill_mode="upper")
        wp.tile_store(lam_out[worldid], wp.tile_cholesky_solve(hessian, rest, fill_mode="upper"))

    return kernel


@cache
def solve_two_tiled(nv: int, second: bool) -> Any:
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
        if wp.static(second):
            other = wp.tile_load(second_in[worldid], shape=wp.static(nv))
            wp.tile_store(second_out[worldid], wp.tile_cholesky_solve(matrix, other, fill_mode="upper"))

    return kernel
