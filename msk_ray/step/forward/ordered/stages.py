"""The stages of a step with ordered sums; contacts and rows are sorted between them."""

import copy
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from msk_ray.step.errors import UnsupportedModelError
from msk_ray.step.forward.model_tree import motors_apart
from msk_ray.step.forward.ordered.contacts import ContactOrder
from msk_ray.step.forward.ordered.rows import RowOrder
from msk_ray.step.forward.ordered.slopes import SlopeOrder, slopes_apart
from msk_ray.step.forward.ordered.solve import solve
from msk_ray.step.forward.ordered.tendon_sums import TendonOrder
from msk_ray.step.forward.stages import ComposedStages, Solver, with_options


def check_ordered(mjm: mujoco.MjModel) -> None:
    """Raise UnsupportedModelError for a model whose step has sums without a fixed order here."""
    option = mjm.opt
    obstacles = {
        "solver CG or PGS": option.solver != mujoco.mjtSolver.mjSOL_NEWTON,
        "integrator RK4": option.integrator == mujoco.mjtIntegrator.mjINT_RK4,
        "noslip iterations": option.noslip_iterations > 0,
        "flexes": mjm.nflex > 0,
        "surface velocities": bool(np.any(getattr(mjm, "geom_surfacevel", np.zeros(0)))),
        "actuators on bodies (adhesion)": bool(np.any(mjm.actuator_trntype == mujoco.mjtTrn.mjTRN_BODY)),
    }
    names = [name for name, present in obstacles.items() if present]
    if names:
        raise UnsupportedModelError(
            f"the model uses {', '.join(names)}, whose sums have no fixed order on a GPU: write "
            "execution.deterministic=false"
        )


def racing(mjm: mujoco.MjModel, model: Any) -> frozenset[str]:
    """Stages of mujoco_warp, without the solver, in which several threads add to one number that the state depends on.

    A number to which only one thread adds, once, after it was set to zero, needs no order; neither do zeros.
    """
    trees = np.asarray(mjm.tree_dofnum)
    races_in = {
        "inertia": bool(np.any(mjm.tendon_armature)),
        # J v of a row is summed in parts.
        "constraint": model.nv_pad > model.block_dim.contact_jac_tiled,
        "velocity": bool(np.any(mjm.body_gravcomp))
        or any(np.any(getattr(mjm, f"tendon_{name}", 0)) for name in _TENDON_FORCES),
        "actuation": bool(np.any(mjm.jnt_actfrclimited) or np.any(mjm.jnt_actgravcomp))
        or bool(np.any(mjm.tendon_actfrclimited)),
        # The inertia of a larger tree is factored over its branches.
        "acceleration": len(trees) > 0 and int(trees.max()) > _DENSE_TREE,
        "integration": mjm.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER and not slopes_apart(mjm, model),
    }
    return frozenset(name for name, races in races_in.items() if races)


_TENDON_FORCES = ("stiffness", "stiffnesspoly", "damping", "dampingpoly", "armature")
_DENSE_TREE = 64
"""Number of degrees of freedom of a tree up to which mujoco_warp factors its inertia as one dense block."""


@wp.kernel(enable_backward=False)
def sum_actuators(
    # In:
    rownnz_in: wp.array2d[int],
    rowadr_in: wp.array2d[int],
    colind_in: wp.array2d[int],
    moment_in: wp.array2d[float],
    force_in: wp.array2d[float],
    # Out:
    qfrc_actuator_out: wp.array2d[float],
) -> None:
    """Compute the generalised force of all actuators on a dof, in order."""
    worldid, dof = wp.tid()
    total = float(0.0)
    for u in range(force_in.shape[1]):
        first = rowadr_in[worldid, u]
        for k in range(first, first + rownnz_in[worldid, u]):
            if colind_in[worldid, k] == dof:
                total += moment_in[worldid, k] * force_in[worldid, u]
    qfrc_actuator_out[worldid, dof] = total


class OrderedStages(ComposedStages):
    """The same step with every sum in a fixed order.

    Args:
        mjm: the MjModel.
        model: mujoco_warp's model of it, with a dense Jacobian, before it is sealed. Contacts are sorted in its public
            hook `callback.contactfilter`, at the end of collision detection, after an existing callback.
        fused: a solver with ordered sums; None for the ordered version of mujoco_warp's.
    """

    ordered = True

    def __init__(self, mjm: mujoco.MjModel, model: Any, fused: Solver | None = None) -> None:
        super().__init__(fused or self._solve_ordered, unrolls=fused is None)
        assert not model.is_sparse, "only dense Jacobians have ordered rows"
        self._correct_contacts = model.callback.contactfilter
        model.callback.contactfilter = self.sort_contacts
        self.racing = racing(mjm, model)
        off = bool(mjm.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        self._sums_actuators = not motors_apart(mjm) and not off and "actuation" not in self.racing
        self._atomic, opt = copy.copy(model), copy.copy(model.opt)
        opt.deterministic = int(mjw.DeterminismType.ATOMICS)
        self._atomic.opt = opt
        self._tendons = TendonOrder(model) if mjm.ntendon else None
        implicit = mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self._slopes = SlopeOrder(mjm, model) if implicit and "integration" not in self.racing else None
        self._contacts: dict[tuple[int, int], ContactOrder] = {}
        self._rows: dict[tuple[int, int], RowOrder] = {}

    def sort_contacts(self, model: Any, data: Any) -> None:
        """Launch the sort of contacts after collision detection."""
        if self._correct_contacts is not None:
            self._correct_contacts(model, data)
        size = (data.nworld, data.naconmax)
        if size not in self._contacts:
            self._contacts[size] = ContactOrder(data)
        self._contacts[size].launch(data)

    def sort_rows(self, data: Any) -> None:
        """Launch the sort of the constraint rows."""
        size = (data.nworld, data.njmax)
        if size not in self._rows:
            self._rows[size] = RowOrder(data)
        self._rows[size].launch(data)

    def position(self, model: Any, data: Any) -> None:
        """Launch the position stage and the sort of its rows."""
        if "inertia" in self.racing:
            mjw.fwd_position(self._atomic, data, factorize=False)
        else:
            mjw.kinematics(model, data)
            mjw.com_pos(model, data)
            self.tendon(model, data)
            mjw.crb(model, data)
            if model.opt.run_collision_detection:
                mjw.collision(model, data)
            mjw.make_constraint(self.of("constraint", model), data)
            mjw.transmission(model, data)
        if data.njmax:
            self.sort_rows(data)

    def tendon(self, model: Any, data: Any) -> None:
        """Launch lengths and Jacobians of tendons."""
        if self._tendons is not None:
            self._tendons.launch(data)

    def slopes(self, model: Any, data: Any, out: wp.array) -> None:
        """Launch M - h ∂τ/∂v of the implicitfast integrator, in the layout of M, into `out` (W, nC)."""
        if self._slopes is not None:
            self._slopes.launch(model, data, out)
        else:
            mjw.deriv_smooth_vel(self.of("integration", model), data, out)

    def summing(self, model: Any) -> Any:
        """A copy of the model with which Warp runs atomic sums in a fixed order."""
        return self._atomic if self.racing else model

    def of(self, stage: str, model: Any) -> Any:
        """The model for a stage; with ordered atomics if the stage's threads race."""
        return self._atomic if stage in self.racing else model

    def actuation(self, model: Any, data: Any) -> None:
        """Launch the forces of actuators."""
        super().actuation(model, data)
        if self._sums_actuators:
            wp.launch(
                sum_actuators,
                dim=(data.nworld, model.nv),
                inputs=[
                    *(data.moment_rownnz, data.moment_rowadr, data.moment_colind, data.actuator_moment),
                    data.actuator_force,
                ],
                outputs=[data.qfrc_actuator],
            )

    def integrate(self, model: Any, data: Any) -> None:
        """Launch the integration."""
        if self._slopes is not None:
            self._slopes.integrate(model, data)
        else:
            super().integrate(model, data)

    def _solve_ordered(self, model: Any, data: Any) -> None:
        # For many degrees of freedom the solver sums rows in parts.
        many = model.nv > _ROW_DOFS
        fixed = {"graph_conditional": False, "iterations": model.opt.iterations}
        solve(with_options(self._atomic, **fixed) if many else model, data)


_ROW_DOFS = 50
"""Number of degrees of freedom up to which one thread multiplies a whole Jacobian row in mujoco_warp's solver."""
