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
MOST_ROWS = 256
"""Rows per world up to which `choose_fused` takes one warp a world."""
_BLOCK = 64
"""Threads per block: two worlds."""


def _obstacles(mjm: mujoco.MjModel) -> list[str]:
    """What in the model needs another solver, or more than one solve per step."""
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
    return [name for name, present in obstacles.items() if present]


def check_fused(mjm: mujoco.MjModel) -> None:
    """Raise UnsupportedModelError if the fused solver is not for this model."""
    if names := _obstacles(mjm):
        raise UnsupportedModelError(
            f"the model uses {', '.join(names)}, for which there is no fused solver: write "
            "execution.solver_kernels: mujoco_warp"
        )


def choose_fused(mjm: mujoco.MjModel, rows: int) -> bool:
    """Whether to solve a model with room for this many rows per world in one kernel.

    Not where the model asks for a sparse Jacobian, or for more rows than a warp should go through alone.
    """
    sparse = mjm.opt.jacobian == mujoco.mjtJacobian.mjJAC_SPARSE
    return not sparse and rows <= MOST_ROWS and not _obstacles(mjm)


class FusedSolver:
    """Newton's method with all iterations of a world in one warp: one launch per step.

    Mathematics, stopping criteria and results in Data are the same as of `mujoco_warp.solve` with a dense Jacobian.
    Each world stops when it has converged, without waiting for others.
    """

    def __init__(self) -> None:
        self._scratch: dict[tuple[int, ...], Any] = {}

    def __call__(self, model: Any, data: Any) -> None:
        """Launch the solver on the results of the earlier stages in `data`."""
        if data.njmax == 0 or model.nv == 0:
            mjw.solve(model, data)
            return
        opt = model.opt
        elliptic = opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
        size = (data.nworld, data.njmax, model.nv, data.efc.J.shape[2] if elliptic else 0)
        if size not in self._scratch:
            self._scratch[size] = make_scratch(*size)
        scratch = self._scratch[size]
        wp.launch(
            solve_world,
            dim=data.nworld * (WARP if data.qpos.device.is_cuda else 1),
            inputs=[
                *(model.nv, opt.impratio_invsqrt, gather(Limits, opt)),
                not opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART,
                elliptic,
                gather(Inertia, model, data),
                *(data.ne, data.nf, data.nl, data.nefc, data.njmax),
                *(data.qfrc_smooth, data.qacc_smooth, data.qacc_warmstart),
            ],
            outputs=[_rows(data, scratch.squared if elliptic else None), scratch, gather(Solution, data, data.efc)],
            block_dim=_BLOCK,
        )


def _rows(data: Any, copies: wp.array | None) -> Any:
    """The rows of `data`, with the Jacobian flattened to one row per world, and with room for copies of it if they are
    replaced."""
    jacobian = data.efc.J
    worlds, count, width = jacobian.shape
    assert jacobian.is_contiguous, "the rows of the Jacobian are not side by side"
    assert width % 4 == 0, "the rows of the Jacobian are no whole fours"
    flat = jacobian.reshape((worlds, count * width))
    view = SimpleNamespace(jacobian=flat, stride=width, squared=flat if copies is None else copies)
    return gather(Rows, view, data.efc, data.contact)
