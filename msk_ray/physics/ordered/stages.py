"""The stages of a step: mujoco_warp's own, or those between which contacts and rows are sorted."""

import copy
from typing import Any, Protocol

import mujoco
import mujoco_warp as mjw
import numpy as np

from msk_ray.errors import UnsupportedModelError
from msk_ray.physics.ordered.contacts import ContactOrder
from msk_ray.physics.ordered.rows import RowOrder
from msk_ray.physics.ordered.solve import solve


class Stages(Protocol):
    """Launches of a step and of its parts."""

    ordered: bool
    """Whether they add everything up in a fixed order."""

    def step(self, model: Any, data: Any) -> None:
        """Launch one physics step."""

    def position(self, model: Any, data: Any) -> None:
        """Launch the position stage, without a factor of the inertia."""

    def summing(self, model: Any) -> Any:
        """The model to give to stages of mujoco_warp that are launched one by one."""


class PackageStages:
    """mujoco_warp's."""

    ordered = False

    def step(self, model: Any, data: Any) -> None:
        """Launch `mujoco_warp.step`."""
        mjw.step(model, data)

    def position(self, model: Any, data: Any) -> None:
        """Launch `mujoco_warp.fwd_position`."""
        mjw.fwd_position(model, data, factorize=False)

    def summing(self, model: Any) -> Any:
        """The model itself."""
        return model


def check_ordered(mjm: mujoco.MjModel) -> None:
    """Raise UnsupportedModelError where sums of a step have no fixed order here."""
    option = mjm.opt
    found = {
        "solver CG or PGS": option.solver != mujoco.mjtSolver.mjSOL_NEWTON,
        "integrator RK4": option.integrator == mujoco.mjtIntegrator.mjINT_RK4,
        "noslip iterations": option.noslip_iterations > 0,
        "flexes": mjm.nflex > 0,
        "surface velocities": bool(np.any(getattr(mjm, "geom_surfacevel", np.zeros(0)))),
        "actuators on bodies (adhesion)": bool(np.any(mjm.actuator_trntype == mujoco.mjtTrn.mjTRN_BODY)),
    }
    names = [name for name, present in found.items() if present]
    if names:
        raise UnsupportedModelError(
            f"the model uses {', '.join(names)}, whose sums have no fixed order on a GPU: write "
            "trial.deterministic=false"
        )


def sums_race(mjm: mujoco.MjModel, model: Any) -> bool:
    """Whether several threads add to one number in a stage of mujoco_warp that the state depends on, the solver aside.

    A number to which one thread adds once, after it was set to zero, needs no order.
    """
    joints = mjm.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    single = bool(np.all(joints)) and len(set(mjm.actuator_trnid[:, 0])) == mjm.nu
    return bool(
        mjm.ntendon
        or not single
        or np.any(mjm.body_gravcomp)
        or mjm.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER
        # J v of a row is added up in parts. For twice as many, the inertia is factored over the tree, too.
        or model.nv_pad > model.block_dim.contact_jac_tiled
    )


def dense(mjm: mujoco.MjModel) -> mujoco.MjModel:
    """The model with a dense Jacobian, for which alone the solver's sums have an order."""
    if mjm.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE:
        return mjm
    changed = copy.copy(mjm)
    changed.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return changed


def with_options(model: Any, **options: Any) -> Any:
    """A copy of mujoco_warp's model with other options and the same arrays."""
    changed, opt = copy.copy(model), copy.copy(model.opt)
    # The seal is not for these copies, which no recorded graph reads.
    for name, value in options.items():
        object.__setattr__(opt, name, value)
    object.__setattr__(changed, "opt", opt)
    return changed


class OrderedStages:
    """The same step with every sum in a fixed order.

    Args:
        mjm: the MjModel.
        model: mujoco_warp's model of it, with a dense Jacobian, before it is sealed. Contacts are sorted by its public
            hook `callback.contactfilter`, which ends collision detection.
    """

    ordered = True

    def __init__(self, mjm: mujoco.MjModel, model: Any) -> None:
        assert not model.is_sparse, "only dense Jacobians have ordered rows"
        model.callback.contactfilter = self.sort_contacts
        self._atomic, opt = copy.copy(model), copy.copy(model.opt)
        if sums_race(mjm, model):
            opt.deterministic = int(mjw.DeterminismType.ATOMICS)
        self._atomic.opt = opt
        self._contacts: dict[tuple[int, int], ContactOrder] = {}
        self._rows: dict[tuple[int, int], RowOrder] = {}

    def sort_contacts(self, model: Any, data: Any) -> None:
        """Launch the sort of the contacts that collision detection has found."""
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
        """Launch the position stage, and the sort of its rows."""
        mjw.fwd_position(self._atomic, data, factorize=False)
        if data.njmax:
            self.sort_rows(data)

    def summing(self, model: Any) -> Any:
        """A model whose sums through atomics Warp adds up in a fixed order."""
        return self._atomic

    def step(self, model: Any, data: Any) -> None:
        """Launch one physics step: `mujoco_warp.step`, stage by stage."""
        atomic = self._atomic
        self.position(model, data)
        data.sensordata.zero_()
        mjw.sensor_pos(atomic, data)
        data.energy.zero_()
        mjw.fwd_velocity(atomic, data)
        mjw.sensor_vel(atomic, data)
        mjw.fwd_actuation(atomic, data)
        mjw.fwd_acceleration(atomic, data, factorize=True)
        # For many degrees of freedom the solver adds rows up in parts.
        many = model.nv > _ROW_DOFS
        fixed = {"graph_conditional": False, "iterations": model.opt.iterations}
        solve(with_options(atomic, **fixed) if many else model, data)
        mjw.sensor_acc(atomic, data)
        if model.opt.integrator == mjw.IntegratorType.EULER:
            mjw.euler(atomic, data)
        else:
            mjw.implicit(atomic, data)


_ROW_DOFS = 50
"""Degrees of freedom up to which one thread multiplies a whole row of the Jacobian in mujoco_warp's solver."""
