"""The two linear systems of a substep: (M + hB) μ = h v̄' and H λ = M μ with H = M + JᵀSJ."""

import warp as wp

from msk_ray.step.adjoint.groups import Contacts, RowLaws, Rows, Substep
from msk_ray.step.adjoint.laws.rows import ConstraintLaws, Squares, square_rows
from msk_ray.step.adjoint.stages.cholesky import solve_both, solve_one
from msk_ray.step.adjoint.stages.free_bodies import FreeBodySolves
from msk_ray.step.adjoint.stages.integrate import Integrator
from msk_ray.step.adjoint.workspace import Workspace
from msk_ray.step.forward.fused.dense import add_squares
from msk_ray.step.forward.fused.lanes import WARP, at, lane_count, lane_sync, put
from msk_ray.step.forward.fused.scratch import padded

wp.set_module_options({"enable_backward": False})


@wp.kernel
def build_matrices(
    # Model:
    nv: int,
    coupled: bool,
    inertia_address: wp.array2d[int],
    opt_impratio_invsqrt: wp.array[float],
    # In:
    nefc_in: wp.array[int],
    M_in: wp.array2d[float],
    step_in: wp.array2d[float],
    step_dense: bool,
    rows_in: Rows,
    laws_in: RowLaws,
    contacts_in: Contacts,
    jacobian_in: wp.array2d[float],
    stride: int,
    width: int,
    # Out:
    squares_out: Squares,
    implicit_out: wp.array2d[float],
    hessian_out: wp.array2d[float],
) -> None:
    """M + hB and H = M + JᵀSJ as full matrices, whose rows are `width` numbers apart, by the lanes of a world.

    `step_in` is the diagonal hB, shape (W, nv), or with `step_dense` all of M + hB in M's sparse layout; the rows of
    `jacobian_in`, one after the other, are `stride` numbers long.
    """
    thread = wp.tid()
    worldid = thread // lane_count()
    lane = thread % lane_count()
    implicit = implicit_out[worldid]
    hessian = hessian_out[worldid]
    for e in range(lane, nv * nv, lane_count()):
        i = e // nv
        j = e % nv
        address = inertia_address[wp.max(i, j), wp.min(i, j)]
        entry = float(0.0)
        step = float(0.0)
        if address >= 0:
            entry = M_in[worldid, address]
            step = entry
        if step_dense:
            if address >= 0:
                step = step_in[worldid, address]
        elif i == j:
            step += step_in[worldid, i]
        put(implicit, i * width + j, step)
        put(hessian, i * width + j, entry)
    count = wp.min(nefc_in[worldid], laws_in.jar.shape[1])
    weight = laws_in.slope[worldid]
    rows = jacobian_in[worldid]
    if coupled:
        impratio = opt_impratio_invsqrt[worldid % opt_impratio_invsqrt.shape[0]]
        square_rows(worldid, count, lane, impratio, rows_in, rows, stride, laws_in, contacts_in, squares_out)
        weight = squares_out.weight[worldid]
        rows = squares_out.rows[worldid]
    lane_sync()
    add_squares(hessian, weight, rows, count, stride, width, lane, lane_count(), hessian)
    lane_sync()
    for e in range(lane, nv * nv, lane_count()):
        i = e // nv
        j = e % nv
        if j < i:
            put(hessian, i * width + j, at(hessian, j * width + i))


@wp.kernel
def damping_product(
    # Model:
    inertia_address: wp.array2d[int],
    # In:
    M_in: wp.array2d[float],
    step_in: wp.array2d[float],
    x_in: wp.array2d[float],
    start_in: wp.array2d[float],
    scale_in: float,
    # Out:
    y_out: wp.array2d[float],
) -> None:
    """hB x, or with a negative scale start + scale · hB x; hB = (M + hB) - M in M's sparse layout."""
    worldid, i = wp.tid()
    total = float(0.0)
    for j in range(x_in.shape[1]):
        address = inertia_address[wp.max(i, j), wp.min(i, j)]
        if address >= 0:
            total += (step_in[worldid, address] - M_in[worldid, address]) * x_in[worldid, j]
    y_out[worldid, i] = scale_in * total
    if scale_in < 0.0:
        y_out[worldid, i] = start_in[worldid, i] + scale_in * total


def flat(matrices: wp.array) -> wp.array:
    """A matrix of each world, (W, R, C), as (W, R C)."""
    return matrices.reshape((matrices.shape[0], -1))


class LinearSystems:
    """Launches of the solves for μ, a - â and λ."""

    def __init__(self, work: Workspace, integrator: Integrator, laws: ConstraintLaws) -> None:
        self._work, self._integrator, self._laws = work, integrator, laws
        worlds, nv = work.nworld, work.mjm.nv
        self._width = padded(nv)
        shape = (worlds, self._width, self._width)
        self._implicit, self._hessian = (wp.zeros(shape, dtype=float) for _ in range(2))
        if work.settings.implicit_all:
            self._step = wp.zeros((worlds, work.model.nC), dtype=float)
            self._push = wp.zeros((worlds, nv), dtype=float)
            alone = work.tables.free_body.size > 0
            self._free = FreeBodySolves(work) if alone else None

    def launch(self, at: Substep) -> None:
        """Launch the matrices and their solves."""
        work, m, d, settings = self._work, self._work.model, at.data, self._work.settings
        if settings.implicit_all:
            # M - h ∂τ/∂v of the implicitfast integrator, in the sparse layout of M
            work.stages.slopes(m, d, self._step)
            if self._free is not None:
                self._free.hold(at, self._step)
        named = {"coupled": settings.elliptic, "step_dense": settings.implicit_all, "width": self._width}
        named |= {"step": self._step if settings.implicit_all else self._integrator.damping_step}
        named |= {"jacobian": flat(at.jacobian), "stride": at.jacobian.shape[2]}
        named |= {"implicit": flat(self._implicit), "hessian": flat(self._hessian)}
        threads = work.nworld * (WARP if work.device.is_cuda else 1)
        work.launch(build_matrices, threads, at, self._laws.squares, **named)
        if settings.implicit_all:
            self._solve_implicit(at)
            return
        inputs = [self._implicit, self._hessian, work.rhs, self._integrator.damping_step, d.qacc]
        solve_both(inputs, [work.multipliers.mu, work.multipliers.excess, work.multipliers.lam])

    def _solve_implicit(self, at: Substep) -> None:
        """μ, a - â and λ where B is a matrix: (M + hB)(a - â) = hB a ,  H λ = h v̄' - hB μ."""
        d, multipliers, rhs = at.data, self._work.multipliers, self._work.rhs
        self._product(at, d.qacc, 1.0)
        solve_one(self._implicit, [rhs, self._push], [multipliers.mu, multipliers.excess])
        self._product(at, multipliers.mu, -1.0)
        if self._free is not None:
            self._free.launch(at, self._push)
        solve_one(self._hessian, [self._push], [multipliers.lam])

    def _product(self, at: Substep, x: wp.array, scale: float) -> None:
        work = self._work
        named = {"step": self._step, "x": x, "start": work.rhs, "scale": scale, "y": self._push}
        work.launch(damping_product, (work.nworld, work.model.nv), at, **named)
