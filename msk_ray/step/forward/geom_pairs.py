"""Pairs of geoms that a model lets collide, and the contacts that mujoco_warp can return for one of them."""

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

# Contacts mujoco_warp can return for one pair of geoms, by the less common of the two types.
_CONTACTS_PER_PAIR = {
    mujoco.mjtGeom.mjGEOM_SPHERE: 1,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: 1,
    mujoco.mjtGeom.mjGEOM_CAPSULE: 2,
    mujoco.mjtGeom.mjGEOM_CYLINDER: 4,
    mujoco.mjtGeom.mjGEOM_BOX: 8,
    mujoco.mjtGeom.mjGEOM_MESH: 8,
}
_UNBOUNDED = 1 << 30
"""Stands for a geometry whose contacts are not bounded by its type: height fields, signed distance fields."""


def candidate_pairs(model: mujoco.MjModel, filtered: bool) -> NDArray[np.int64]:
    """Pairs of geoms that the collision masks let through or that are listed, the smaller id first, shape (P, 2).

    Args:
        filtered: leave out what mujoco_warp leaves out besides: excluded bodies, parent with child, one welded body.
    """
    a, b = np.triu_indices(model.ngeom, 1)
    one, other = model.geom_contype, model.geom_conaffinity
    keep = ((one[a] & other[b]) | (one[b] & other[a])) != 0
    body1, body2 = model.geom_bodyid[a], model.geom_bodyid[b]
    keep &= body1 != body2
    if filtered:
        low, high = np.minimum(body1, body2).astype(np.int64), np.maximum(body1, body2).astype(np.int64)
        keep &= ~np.isin((low << 16) + high, model.exclude_signature)
        weld1, weld2 = model.body_weldid[body1], model.body_weldid[body2]
        keep &= weld1 != weld2
        if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
            parent1, parent2 = (model.body_weldid[model.body_parentid[w]] for w in (weld1, weld2))
            keep &= ~((weld1 != 0) & (weld2 != 0) & ((parent1 == weld2) | (parent2 == weld1)))
    listed = np.sort(np.stack((model.pair_geom1, model.pair_geom2), axis=1), axis=1)
    found = np.concatenate((np.stack((a[keep], b[keep]), axis=1), listed))
    return np.unique(found, axis=0).astype(np.int64).reshape(-1, 2)


def contacts_of(model: mujoco.MjModel, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Contacts each pair can have at most, shape (P,); enormous where its types set no bound."""
    counts = np.full(model.ngeom, _UNBOUNDED, dtype=np.int64)
    for kind, count in _CONTACTS_PER_PAIR.items():
        counts[model.geom_type == kind] = count
    # A plane adds none of its own: the other geom decides.
    plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    counts[plane] = 2 * _UNBOUNDED
    least = counts[pairs].min(axis=1) if len(pairs) else np.zeros(0, np.int64)
    both = counts[pairs].max(axis=1) if len(pairs) else least
    unbounded = both == _UNBOUNDED
    least = np.where(unbounded, _UNBOUNDED, least)
    return np.where(least == 2 * _UNBOUNDED, 0, least)


def rows_per_contact(model: mujoco.MjModel, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Constraint rows of one contact of each pair, shape (P,)."""
    dims = model.geom_condim[pairs].max(axis=1).astype(np.int64) if len(pairs) else np.zeros(0, np.int64)
    place = {(int(a), int(b)): k for k, (a, b) in enumerate(pairs)}
    for a, b, dim in zip(model.pair_geom1, model.pair_geom2, model.pair_dim, strict=True):
        dims[place[min(int(a), int(b)), max(int(a), int(b))]] = dim
    if model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return np.where(dims == 1, 1, 2 * (dims - 1))
    return dims


def widened(mjm: mujoco.MjModel, reach: float) -> mujoco.MjModel:
    """A model that finds contacts within `reach` of touching, and steps as before.

    Args:
        mjm: the MjModel, which stays as it is.
        reach: distance [m].
    """
    other = copy.copy(mjm)
    other.geom_gap[:] = other.geom_gap + 0.5 * reach
    other.pair_gap[:] = other.pair_gap + reach
    return other
