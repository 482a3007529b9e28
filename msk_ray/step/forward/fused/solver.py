"""Launching the fused solver, and checking which models it supports."""

from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

from msk_ray.step.errors import UnsupportedModelError
from msk_ray.step.forward.arrays import gather
from msk_ray.step.forward.fused.lanes import WARP
from msk_ray.step.forward.fused.newton import Inertia, Limits, Solution, solve_world
from msk_ray.step.forward.fused.problem import Rows
from msk_ray.step.forward.fused.scratch import make_scratch

MOST_DOFS = 60
"""Number of degrees of freedom up to which MuJoCo itself uses a dense Jacobian."""
_BLOCK = 64
"""Threads per block: two worlds."""


def check_fused(mjm: mujoco.MjModel) -> None:
    """Raise UnsupportedModelError if the model needs another solver, or more than one solve per step."""
    option = mjm.opt
    known = (
        mujoco.mjtIntegrator.mjINT_EULER,
        mujoco.mjtIntegrator.mjINT_IMPLICIT,
        mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    )
    obstacles = {
        "solver CG or PGS": option.solver != mujoco.mjtSolver.mjSOL_NEWTON,
        f"integrator {mujoco.mjtIntegrator(option.integrator).name[6:]}": option.integrator not in known,
        "noslip iterations": option.noslip_iterations > 0,
        "flexes": mjm.nflex > 0,
        f"{mjm.nv} degrees of freedom, more than {MOST_DOFS}": mjm.nv > MOST_DOFS,
    }
    names = [name for name, present in obstacles.items() if present]
    if names:
        raise UnsupportedModelError(
            f"the model uses {', '.join(names)}, for which there is no fused solver: write "
            "execution.solver_kernels: mujoco_warp"
        )


class FusedSolver:
    """Newton's method with all iterations of a world in one warp: one launch per step.

    Mathematics, stopping criteria and results in Data are the same as of `mujoco_warp.solve` with a dense Jacobian.
    Each world stops when it has converged, without waiting for others.
    """

    def __init__(self) -> None:
        self._scratch: dict[tuple[int, int, int], Any] = {}

    def __call__(self, model: Any, data: Any) -> None:
        """Launch the solver on the results of the earlier stages in `data`."""
        if data.njmax == 0 or model.nv == 0:
            mjw.solve(model, data)
            return
        size = (data.nworld, data.njmax, model.nv)
        if size not in self._scratch:
            self._scratch[size] = make_scratch(*size)
        opt = model.opt
        wp.launch(
            solve_world,
            dim=data.nworld * (WARP if data.qpos.device.is_cuda else 1),
            inputs=[
                *(model.nv, opt.impratio_invsqrt, gather(Limits, opt)),
                not opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART,
                gather(Inertia, model, data),
                *(data.ne, data.nf, data.nl, data.nefc, data.njmax),
                *(data.qfrc_smooth, data.qacc_smooth, data.qacc_warmstart),
            ],
            outputs=[_rows(data), self._scratch[size], gather(Solution, data, data.efc)],
            block_dim=_BLOCK,
        )


def _rows(data: Any) -> Any:
    """The rows of `data`, with the Jacobian flattened to one row per world."""
    jacobian = data.efc.J
    worlds, count, width = jacobian.shape
    assert jacobian.is_contiguous, "the rows of the Jacobian are not side by side"
    assert width % 4 == 0, "the rows of the Jacobian are no whole fours"
    view = SimpleNamespace(jacobian=jacobian.reshape((worlds, count * width)), stride=width)
    return gather(Rows, view, data.efc, data.contact)
