"""`nworld` copies of one model, stepped together by an unmodified mujoco_warp."""

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp import OverflowType
from numpy.typing import NDArray

from msk_ray.errors import SimulationError, UnsupportedModelError

# Contacts mujoco_warp can return for one pair of geoms, by the less common of the two types.
_CONTACTS_PER_PAIR = {
    mujoco.mjtGeom.mjGEOM_SPHERE: 1,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: 1,
    mujoco.mjtGeom.mjGEOM_CAPSULE: 2,
    mujoco.mjtGeom.mjGEOM_CYLINDER: 4,
    mujoco.mjtGeom.mjGEOM_BOX: 8,
    mujoco.mjtGeom.mjGEOM_MESH: 8,
}
# Largest bound worth allocating per world; above it mujoco_warp's own guess is used instead.
_MAX_BOUNDED_CONTACTS = 256
# Bits that tell of lost contacts or constraint rows, as against an iteration limit that only costs accuracy.
_ITERATION_BITS = OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS


def contact_capacity(model: mujoco.MjModel) -> tuple[int, int] | None:
    """Upper bound (contacts, constraint rows) of one world, or None where no small bound is known.

    Counts every pair of geoms that the collision masks or explicit pairs let through; the parent filter is not
    applied, so the bound errs upwards.
    """
    pairs = {(int(a), int(b)) for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    dims = {
        (int(a), int(b)): int(d) for a, b, d in zip(model.pair_geom1, model.pair_geom2, model.pair_dim, strict=True)
    }
    for a in range(model.ngeom):
        for b in range(a + 1, model.ngeom):
            if model.geom_bodyid[a] == model.geom_bodyid[b]:
                continue
            if (model.geom_contype[a] & model.geom_conaffinity[b]) or (
                model.geom_contype[b] & model.geom_conaffinity[a]
            ):
                pairs.add((a, b))
    contacts = rows = 0
    pyramidal = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    for a, b in pairs:
        types = {mujoco.mjtGeom(model.geom_type[g]) for g in (a, b)} - {mujoco.mjtGeom.mjGEOM_PLANE}
        if not types <= _CONTACTS_PER_PAIR.keys():
            return None
        count = min((_CONTACTS_PER_PAIR[t] for t in types), default=0)
        dim = dims.get((a, b), max(int(model.geom_condim[a]), int(model.geom_condim[b])))
        contacts += count
        rows += count * (1 if dim == 1 else 2 * (dim - 1) if pyramidal else dim)
    if contacts > _MAX_BOUNDED_CONTACTS:
        return None
    limits = int(np.sum(model.jnt_limited)) + 2 * int(np.sum(model.tendon_limited))
    friction = int(np.sum(model.dof_frictionloss > 0)) + int(np.sum(model.tendon_frictionloss > 0))
    # A hinge or slide limit can be active on both sides at once inside its margin.
    return max(contacts, 1), max(rows + 2 * limits + friction + 6 * model.neq, 1)


def check_state(model: mujoco.MjModel) -> None:
    """Raise UnsupportedModelError where a step depends on more state than (qpos, qvel, act)."""
    hidden = {
        "actuator or sensor delay (nhistory > 0)": getattr(model, "nhistory", 0) > 0,
        "plastic springs (nplastic > 0)": getattr(model, "nplastic", 0) > 0,
        "sleeping (<flag sleep='enable'/>)": bool(model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP),
        "mocap bodies (nmocap > 0)": model.nmocap > 0,
    }
    found = [name for name, present in hidden.items() if present]
    if found:
        raise UnsupportedModelError(
            f"the model uses {', '.join(found)}: its step depends on state outside (qpos, qvel, act); "
            "remove it from the model"
        )


def refresh_velocity(mjm: mujoco.MjModel, model: Any, data: Any) -> None:
    """Launch the velocity stage early where constraints are built from it.

    mujoco_warp 4.0.0 builds connect and weld rows in its position stage from the body velocities in `data`, which are
    those of the step before unless this comes first. C MuJoCo takes the present ones.
    """
    if np.any(np.isin(mjm.eq_type, [int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)])):
        mjw.kinematics(model, data)
        mjw.com_pos(model, data)
        mjw.com_vel(model, data)


class WorldBatch:
    """Model and data of `nworld` worlds on one device, with the launches of one env step.

    An env step is `substeps` calls of `mujoco_warp.step` under one control. It is a pure function of
    (ctrl, qpos, qvel, act): the solver starts cold at its first substep and warm at the others.

    Attributes:
        mjm: the C MuJoCo model.
        model, data: mujoco_warp's copies on the device.
        nworld: number of worlds W.
        substeps: physics steps an env step.
        device: the Warp device.

    Raises:
        UnsupportedModelError: mujoco_warp cannot load the model, or it has state outside (qpos, qvel, act).
    """

    def __init__(
        self,
        mjm: mujoco.MjModel,
        nworld: int,
        substeps: int,
        device: str,
        *,
        nconmax: int | None = None,
        njmax: int | None = None,
        tolerance: float | None = None,
    ) -> None:
        check_state(mjm)
        self.mjm = mjm
        self.nworld = nworld
        self.substeps = substeps
        self.device = wp.get_device(device)
        self._options: dict[str, Any] = {"nconmax": nconmax, "njmax": njmax, "tolerance": tolerance}
        bound = contact_capacity(mjm)
        if bound is not None:
            nconmax = nconmax or bound[0]
            njmax = njmax or bound[1]
        with wp.ScopedDevice(self.device):
            try:
                self.model = mjw.put_model(mjm)
            except (NotImplementedError, ValueError) as error:
                raise UnsupportedModelError(f"mujoco_warp cannot load the model: {error}") from error
            if tolerance is not None:
                # put_model clamps to 1e-6; the adjoint holds at the optimum only, so it may ask for less.
                self.model.opt.tolerance = wp.array([tolerance], dtype=float)
            self.model.opt.warn_overflow = 0  # read back by `check_overflow`, not printed from kernels
            self.data = mjw.make_data(mjm, nworld=nworld, nconmax=nconmax, njmax=njmax)

    def resized(self, nworld: int) -> "WorldBatch":
        """Another batch of the same model and settings with `nworld` worlds."""
        return WorldBatch(self.mjm, nworld, self.substeps, str(self.device), **self._options)

    def begin_step(self) -> None:
        """Launch what makes an env step independent of the one before."""
        self.data.qacc_warmstart.zero_()
        self.data.time.zero_()

    def launch_step(self) -> None:
        """Launch one env step on the current contents of data.{ctrl, qpos, qvel, act}."""
        self.begin_step()
        for _ in range(self.substeps):
            self.launch_substep(self.data)

    def launch_substep(self, data: Any) -> None:
        """Launch one physics step on `data`, this batch's own or another of the same model and size."""
        refresh_velocity(self.mjm, self.model, data)
        mjw.step(self.model, data)

    def set_contact_pairs(self, fields: dict[str, NDArray[np.float64]]) -> None:
        """Change what contact pairs are made of, from the next step on; recorded graphs follow.

        Args:
            fields: of solref (P, 2), solreffriction (P, 2), solimp (P, 5), friction (P, 5), those that change, for the
                P pairs in the model's order.
        """
        for name, value in fields.items():
            array = getattr(self.model, f"pair_{name}")
            # In place: a recorded graph reads this memory.
            array.assign(np.asarray(value, np.float32).reshape(*array.shape, -1))

    def check_overflow(self) -> float:
        """Share of worlds whose solver met an iteration limit since the last call.

        Raises:
            SimulationError: contacts or constraint rows were lost because a buffer was too small.
        """
        bits = self.data.overflow.numpy().copy()  # on CPU numpy() is a view, and the next line clears it
        self.data.overflow.zero_()
        lost = np.bitwise_or.reduce(bits) & ~int(_ITERATION_BITS)
        if lost:
            names = OverflowType(int(lost)).name
            raise SimulationError(
                f"mujoco_warp ran out of {names} space in {int(np.count_nonzero(bits & lost))} of {self.nworld} "
                f"worlds; raise physics.nconmax (now {self.data.naconmax // self.nworld}) or physics.njmax "
                f"(now {self.data.njmax})"
            )
        return float(np.mean(bits != 0))
