"""The solver as a launch, for models that it can take."""

from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

from msk_ray.errors import UnsupportedModelError
from msk_ray.physics.arrays import gather
from msk_ray.physics.fused.newton import Limits, Solution, solve_world
from msk_ray.physics.fused.problem import RowsIn
from msk_ray.physics.fused.scratch import make_scratch

MOST_DOFS = 60
"""Degrees of freedom up to which MuJoCo itself takes a dense Jacobian. The work of a thread grows with their cube."""
WARPS = 8
"""Warps on each multiprocessor of a GPU among which worlds are spread: two for each of its schedulers, of which one can
work while the other waits for memory. The worlds of a warp wait for each other, so that few are better than 32."""


def check_fused(mjm: mujoco.MjModel) -> None:
    """Raise UnsupportedModelError where a step needs another solver, or solves more than once."""
    option = mjm.opt
    known = (
        mujoco.mjtIntegrator.mjINT_EULER,
        mujoco.mjtIntegrator.mjINT_IMPLICIT,
        mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    )
    found = {
        "solver CG or PGS": option.solver != mujoco.mjtSolver.mjSOL_NEWTON,
        f"integrator {mujoco.mjtIntegrator(option.integrator).name[6:]}": option.integrator not in known,
        "noslip iterations": option.noslip_iterations > 0,
        "flexes": mjm.nflex > 0,
        f"{mjm.nv} degrees of freedom, more than {MOST_DOFS}": mjm.nv > MOST_DOFS,
    }
    names = [name for name, present in found.items() if present]
    if names:
        raise UnsupportedModelError(
            f"the model uses {', '.join(names)}, for which there is no fused solver: write "
            "physics.solver_kernels: mujoco_warp"
        )


def lanes_of(worlds: int, device: wp.Device) -> int:
    """Worlds of a warp: 32 or a smaller power of 2."""
    if not device.is_cuda:
        return 32
    share = -(-worlds // (WARPS * device.sm_count))
    return min(32, 1 << (share - 1).bit_length())


class FusedSolver:
    """Newton's method of each world in one thread, from its first iteration to its last: one launch a step.

    The mathematics, the criteria to stop and the results in Data are those of `mujoco_warp.solve` for a dense Jacobian.
    A world stops when it has converged, and waits for no other than those of its warp.
    """

    def __init__(self) -> None:
        self._scratch: dict[tuple[int, int, int], Any] = {}

    def __call__(self, model: Any, data: Any) -> None:
        """Launch it on what the stages before it left in `data`."""
        if data.njmax == 0 or model.nv == 0:
            mjw.solve(model, data)
            return
        size = (data.nworld, data.njmax, model.nv)
        if size not in self._scratch:
            self._scratch[size] = make_scratch(*size)
        lanes = lanes_of(data.nworld, data.qpos.device)
        opt = model.opt
        limits = gather(Limits, opt)
        rows = _rows(data)
        wp.launch(
            solve_world,
            dim=-(-data.nworld // lanes) * 32,
            inputs=[
                *(model.nv, model.M_rownnz, model.M_rowadr, model.M_colind, opt.impratio_invsqrt, limits),
                not opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART,
                lanes,
                *(data.ne, data.nf, data.nefc, data.njmax, data.M),
                *(data.qfrc_smooth, data.qacc_smooth, data.qacc_warmstart),
                rows,
            ],
            outputs=[self._scratch[size], gather(Solution, data, data.efc)],
            block_dim=32,
        )


def _rows(data: Any) -> Any:
    """The rows of `data`, and its Jacobian in blocks: it has room for whole ones in every row."""
    jacobian = data.efc.J
    worlds, count, width = jacobian.shape
    assert jacobian.is_contiguous, "the rows of the Jacobian are not side by side"
    assert width % 4 == 0, "the rows of the Jacobian are no whole blocks"
    view = wp.array(ptr=jacobian.ptr, dtype=wp.vec4, shape=(worlds, count * width // 4), device=jacobian.device)
    return gather(RowsIn, SimpleNamespace(jacobian=view, jacobian_blocks=width // 4), data.efc, data.contact)
