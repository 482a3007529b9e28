"""How many contacts and constraint rows a world needs: bounded by the geometry, or measured by a probe in C MuJoCo."""

import hashlib
import math
from typing import Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from msk_ray.step.forward.geom_pairs import candidate_pairs, contacts_of, rows_per_contact

_LARGEST_BOUND = 256
"""Contacts per world up to which the geometric bound is allocated; above it a probe measures what is needed."""
_MARGIN = 1.5
"""Factor on what the probe needed, because a policy reaches states that random controls do not."""
_PROBE_TIME = 1.0
"""Simulated time of each rollout of the probe [s]."""
_PROBE_STEPS = 5000
"""Largest number of steps of all rollouts together."""
_PROBE_WORK = 400_000
"""Limit on steps × cost of a step, in degrees of freedom plus a twentieth of the pairs. A time limit would not
repeat."""
_RANDOM_STARTS = 6
_FEW_CONTACTS = [
    mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_MESH,
    mujoco.mjtGeom.mjGEOM_SDF,
]
"""Types with which a pair may go through the convex collider and count as fewer than four contacts."""
_CONTROL_INTERVAL = 0.05
"""How long a probe holds each random control [s]."""
_LOOKS = 25
"""Number of samples of each rollout."""

Array = NDArray[np.float64]


class Capacity(NamedTuple):
    """Room of one world. mujoco_warp pools the contacts of all worlds, but not their rows."""

    contacts: int = 0
    """The larger one of the number of contacts and the number of pairs that pass the broad phase."""
    rows: int = 0
    """Constraint rows."""

    def at_least(self, other: "Capacity") -> "Capacity":
        """Elementwise maximum."""
        return Capacity(max(self.contacts, other.contacts), max(self.rows, other.rows))

    def at_most(self, other: "Capacity") -> "Capacity":
        """Elementwise minimum."""
        return Capacity(min(self.contacts, other.contacts), min(self.rows, other.rows))


UNKNOWN: Final = Capacity()
"""Sizes to determine from the model."""


class _Counter:
    """Upper bounds on the room that mujoco_warp needs at a pose, from the pairs of geoms that touch or are near."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._pairs = candidate_pairs(model, filtered=True)
        self._contacts = np.minimum(contacts_of(model, self._pairs), mujoco.mjMAXCONPAIR)
        self._rows = self._contacts * rows_per_contact(model, self._pairs)
        self._place = np.full((model.ngeom, model.ngeom), -1, dtype=np.int32)
        self._place[self._pairs[:, 0], self._pairs[:, 1]] = np.arange(len(self._pairs))
        self._first, self._second = self._pairs.T
        self._radii = model.geom_rbound[self._pairs].sum(axis=1)  # a plane's rbound is zero
        planes = model.geom_type[self._pairs] == mujoco.mjtGeom.mjGEOM_PLANE
        self._flat = np.flatnonzero(planes.any(axis=1))
        self._planes = np.where(planes[:, 0], self._first, self._second)[self._flat]
        self._side = np.where(planes[:, 0], 1.0, -1.0)[self._flat]
        # mujoco_warp's filters use the sum of both margins; for an explicit pair, its own.
        self._reach = (model.geom_margin + model.geom_gap)[self._pairs].sum(axis=1)
        for a, b, margin, gap in zip(
            model.pair_geom1, model.pair_geom2, model.pair_margin, model.pair_gap, strict=True
        ):
            k = self._place[min(a, b), max(a, b)]
            self._reach[k] = max(self._reach[k], margin + gap)

    @property
    def pairs(self) -> int:
        """Pairs of geoms that can touch."""
        return len(self._pairs)

    def __call__(self, data: mujoco.MjData) -> Capacity:
        # Count by touching pairs, because mujoco_warp and C MuJoCo may return different numbers of contacts for a pair.
        geoms = np.sort(np.asarray(data.contact.geom).reshape(-1, 2), axis=1)
        of_geoms = geoms[:, 0] >= 0
        touching = np.unique(self._place[geoms[of_geoms, 0], geoms[of_geoms, 1]])
        touching = touching[touching >= 0]
        contacts = int(self._contacts[touching].sum()) + int(np.count_nonzero(~of_geoms))
        rows = int(self._rows[touching].sum()) + scalar_rows(self._model)
        return Capacity(max(contacts, data.ncon, self._near(data)), max(rows, data.nefc))

    def _near(self, data: mujoco.MjData) -> int:
        """Pairs with overlapping bounding spheres: at least those that pass mujoco_warp's broad phase."""
        between = data.geom_xpos[self._second] - data.geom_xpos[self._first]
        gap = np.sqrt(np.einsum("pi,pi->p", between, between)) - self._radii
        # Height over a plane, whose normal is the z axis of its frame.
        height = np.einsum("pi,pi->p", between[self._flat], data.geom_xmat[self._planes, 2::3])
        gap[self._flat] = self._side * height - self._radii[self._flat]
        return int(np.count_nonzero(gap <= self._reach))


_LEAST = Capacity(48, 64)
"""mujoco_warp's own minimum; less would save nothing."""


def scalar_rows(model: mujoco.MjModel) -> int:
    """Largest number of rows that do not come from contacts."""
    limits = int(np.sum(model.jnt_limited)) + 2 * int(np.sum(model.tendon_limited))
    friction = int(np.sum(model.dof_frictionloss > 0)) + int(np.sum(model.tendon_frictionloss > 0))
    # Both sides of a hinge or slide limit can be active at once, within its margin.
    return 2 * limits + friction + 6 * model.neq


def geometric_bound(model: mujoco.MjModel) -> Capacity | None:
    """Upper bound on the room for any pose; None if the geometry gives no bound (distance fields, flexes).

    Counts every pair of geoms that collision masks or explicit pairs allow. The parent filter is not applied, so the
    bound may be too large. It is zero for a model without contacts and other constraints.
    """
    off, bit = model.opt.disableflags, mujoco.mjtDisableBit
    if off & bit.mjDSBL_CONSTRAINT:
        return Capacity(0, 0)
    if model.nflex:
        return None
    if off & bit.mjDSBL_CONTACT:
        return Capacity(0, scalar_rows(model))
    pairs = candidate_pairs(model, filtered=False)
    counts = contacts_of(model, pairs)
    if np.any(counts > mujoco.mjMAXCONPAIR):
        return None
    contacts = max(int(counts.sum()), len(pairs))
    rows = int((counts * rows_per_contact(model, pairs)).sum()) + scalar_rows(model)
    return Capacity(contacts, rows)


def default_capacity(model: mujoco.MjModel) -> tuple[Capacity, Capacity | None]:
    """Initial room, and the room that is never exceeded (None if unknown).

    They are equal if the geometry allows only few contacts. Otherwise the first is 1.5 times what a short probe needed,
    and may have to grow.
    """
    bound = geometric_bound(model)
    if bound is not None and bound.contacts <= _LARGEST_BOUND:
        return bound, bound
    seen = probe(model)
    fixed = scalar_rows(model)
    tried = Capacity(_rounded(_MARGIN * seen.contacts), _rounded(_MARGIN * max(seen.rows - fixed, 0) + fixed)).at_least(
        _LEAST
    )
    return (tried if bound is None else tried.at_most(bound)), bound


def convex_room(model: mujoco.MjModel, contacts: int) -> int:
    """Pairs of two types of geoms that mujoco_warp's convex collider can take at once, per world, if there is room for
    `contacts`; worlds pool it.

    As many as contacts, except on ground of height fields. A geom that touches a field counts as four contacts, and two
    boxes as eight, so a quarter has room for all that touch; a geom over a field, rarely over two, is a pair even
    before it touches. A pair takes 66 KB with 500 iterations, so this decides how many worlds fit on a GPU. Other
    convex pairs may have one contact each: a model with any has as much room as contacts.
    """
    fields = model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD
    if not fields.any():
        return contacts
    pairs = candidate_pairs(model, filtered=True)
    on_field = fields[pairs].any(axis=1)
    on_plane = (model.geom_type[pairs] == mujoco.mjtGeom.mjGEOM_PLANE).any(axis=1)
    if np.isin(model.geom_type[pairs[~on_field & ~on_plane]], _FEW_CONTACTS).any():
        return contacts
    over_fields = np.unique(pairs[on_field])
    of_a_type = np.bincount(model.geom_type[over_fields[~fields[over_fields]]], minlength=1).max()
    return min(contacts, max(contacts // 4, _rounded(_MARGIN * of_a_type)))


def _rounded(size: float) -> int:
    """Round up to a multiple of eight, so that models of similar size share compiled kernels."""
    return 8 * math.ceil(size / 8.0)


_PROBED: dict[bytes, Capacity] = {}
"""Results by model fingerprint, because training and evaluation each make a simulation of the same model."""


def probe(model: mujoco.MjModel) -> Capacity:
    """Largest need over rollouts of C MuJoCo: from keyframes, at rest, and dropped at random under random controls.

    Deterministic; takes a second or two on one core. The result covers the poses visited, not all possible ones.
    """
    buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    key = hashlib.blake2b(buffer.tobytes(), digest_size=16).digest()
    if key not in _PROBED:
        _PROBED[key] = _probe(model)
    return _PROBED[key]


def _probe(model: mujoco.MjModel) -> Capacity:
    rng = np.random.default_rng(0)
    data, count = mujoco.MjData(model), _Counter(model)
    starts = [model.qpos0, *model.key_qpos[:2]]
    starts += [_random_pose(model, rng) for _ in range(_RANDOM_STARTS)]
    budget = min(_PROBE_STEPS, round(_PROBE_WORK / (model.nv + count.pairs / 20 + 1)))
    steps = max(1, min(round(_PROBE_TIME / model.opt.timestep), budget // len(starts)))
    held = max(1, round(_CONTROL_INTERVAL / model.opt.timestep))
    low, high = _control_range(model)
    most = Capacity(0, 0)
    for start in starts:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = start
        for step in range(steps):
            if step % held == 0:
                data.ctrl[:] = rng.uniform(low, high)
            mujoco.mj_step(model, data)
            if step % max(1, steps // _LOOKS) == 0:
                most = most.at_least(count(data))
    return most


def _control_range(model: mujoco.MjModel) -> tuple[Array, Array]:
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = model.actuator_ctrlrange.T
    return np.where(limited, low, -1.0), np.where(limited, high, 1.0)


def _random_pose(model: mujoco.MjModel, rng: np.random.Generator) -> Array:
    """Random joints in the middle of their ranges; free bodies turned at random and lifted by a quarter of the
    model."""
    qpos = model.qpos0.copy()
    for joint in range(model.njnt):
        kind, at = model.jnt_type[joint], model.jnt_qposadr[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            qpos[at + 2] += 0.25 * model.stat.extent
            at += 3
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            turn = rng.normal(size=4)
            qpos[at : at + 4] = turn / np.linalg.norm(turn)
        elif model.jnt_limited[joint]:
            low, high = model.jnt_range[joint]
            qpos[at] = low + (high - low) * rng.uniform(0.1, 0.9)
        else:
            qpos[at] += rng.uniform(-0.5, 0.5)
    return qpos
