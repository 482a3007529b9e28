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
"""Room beyond what the probe saw: a policy takes the model to places that random controls do not."""
_PROBE_TIME = 1.0
"""Simulated time of each of the probe's rollouts [s]."""
_PROBE_STEPS = 5000
"""Steps of all rollouts together, at most."""
_PROBE_WORK = 400_000
"""Steps times what one costs, in degrees of freedom and twentieths of a pair; a clock would not be repeatable."""
_RANDOM_STARTS = 6
_CONTROL_INTERVAL = 0.05
"""How long a probe holds each random control [s]."""
_LOOKS = 25
"""Times each rollout is looked at."""

Array = NDArray[np.float64]


class Capacity(NamedTuple):
    """Room of one world. mujoco_warp pools the contacts of all worlds, but not their rows."""

    contacts: int = 0
    """Contacts, and pairs of geoms near enough to be looked at, whichever are more."""
    rows: int = 0
    """Constraint rows."""

    def at_least(self, other: "Capacity") -> "Capacity":
        """The larger of both, one by one."""
        return Capacity(max(self.contacts, other.contacts), max(self.rows, other.rows))

    def at_most(self, other: "Capacity") -> "Capacity":
        """The smaller of both, one by one."""
        return Capacity(min(self.contacts, other.contacts), min(self.rows, other.rows))


UNKNOWN: Final = Capacity()
"""To be found from the model."""


class _Counter:
    """Bounds on what mujoco_warp can need at a pose, from the pairs of geoms that touch or come near there."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._pairs = candidate_pairs(model, filtered=True)
        self._contacts = np.minimum(contacts_of(model, self._pairs), mujoco.mjMAXCONPAIR)
        self._rows = self._contacts * rows_per_contact(model, self._pairs)
        self._place = np.full((model.ngeom, model.ngeom), -1, dtype=np.int32)
        self._place[self._pairs[:, 0], self._pairs[:, 1]] = np.arange(len(self._pairs))
        self._first, self._second = self._pairs.T
        self._radii = model.geom_rbound[self._pairs].sum(axis=1)  # a plane's is zero
        planes = model.geom_type[self._pairs] == mujoco.mjtGeom.mjGEOM_PLANE
        self._flat = np.flatnonzero(planes.any(axis=1))
        self._planes = np.where(planes[:, 0], self._first, self._second)[self._flat]
        self._side = np.where(planes[:, 0], 1.0, -1.0)[self._flat]
        # mujoco_warp's filters add both margins up, and take a listed pair's own instead.
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
        # By pairs that touch: mujoco_warp and C MuJoCo may return another number of contacts for the same pair.
        geoms = np.sort(np.asarray(data.contact.geom).reshape(-1, 2), axis=1)
        of_geoms = geoms[:, 0] >= 0
        touching = np.unique(self._place[geoms[of_geoms, 0], geoms[of_geoms, 1]])
        touching = touching[touching >= 0]
        contacts = int(self._contacts[touching].sum()) + int(np.count_nonzero(~of_geoms))
        rows = int(self._rows[touching].sum()) + scalar_rows(self._model)
        return Capacity(max(contacts, data.ncon, self._near(data)), max(rows, data.nefc))

    def _near(self, data: mujoco.MjData) -> int:
        """Pairs whose bounding spheres meet: no fewer than mujoco_warp's broad phase lets through."""
        between = data.geom_xpos[self._second] - data.geom_xpos[self._first]
        gap = np.sqrt(np.einsum("pi,pi->p", between, between)) - self._radii
        # Height over a plane, whose normal is the z axis of its frame.
        height = np.einsum("pi,pi->p", between[self._flat], data.geom_xmat[self._planes, 2::3])
        gap[self._flat] = self._side * height - self._radii[self._flat]
        return int(np.count_nonzero(gap <= self._reach))


_LEAST = Capacity(48, 64)
"""What mujoco_warp gives a small model; less saves nothing."""


def scalar_rows(model: mujoco.MjModel) -> int:
    """Largest number of rows that do not come from contacts."""
    limits = int(np.sum(model.jnt_limited)) + 2 * int(np.sum(model.tendon_limited))
    friction = int(np.sum(model.dof_frictionloss > 0)) + int(np.sum(model.tendon_frictionloss > 0))
    # A hinge or slide limit can be active on both sides at once inside its margin.
    return 2 * limits + friction + 6 * model.neq


def geometric_bound(model: mujoco.MjModel) -> Capacity | None:
    """Room that no pose can exceed, or None where a geometry sets no bound (height fields, distance fields, flexes).

    Counts every pair of geoms that the collision masks or explicit pairs let through; the parent filter is not
    applied, so the bound errs upwards. It is zero for a model without contacts and other constraints.
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
    """Room to start with, and the room that is never exceeded (None where unknown).

    They are the same where the geometry allows few contacts. Otherwise the first is what a short probe needed and half
    as much again, and may have to grow.
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


def _rounded(size: float) -> int:
    """Up to the next multiple of eight, so that models alike in size share compiled kernels."""
    return 8 * math.ceil(size / 8.0)


_PROBED: dict[bytes, Capacity] = {}
"""Results by fingerprint: training and evaluation make a simulation each of the same model."""


def probe(model: mujoco.MjModel) -> Capacity:
    """The most that rollouts of C MuJoCo need: from keyframes, at rest, and dropped at random under random controls.

    Deterministic; a second or two of one core. What it returns covers the poses it saw, not all there are.
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
    """Joints anywhere in the middle of their ranges; free bodies turned anyhow and lifted by a quarter of the model."""
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
