"""Pairs of geoms that can collide, and how many contacts mujoco_warp can return for each."""

import mujoco
import numpy as np
from numpy.typing import NDArray

# Largest number of contacts that mujoco_warp returns for a pair of geoms, by the less common of the two types.
_CONTACTS_PER_PAIR = {
    mujoco.mjtGeom.mjGEOM_SPHERE: 1,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: 1,
    mujoco.mjtGeom.mjGEOM_CAPSULE: 2,
    mujoco.mjtGeom.mjGEOM_CYLINDER: 4,
    mujoco.mjtGeom.mjGEOM_BOX: 8,
    mujoco.mjtGeom.mjGEOM_MESH: 8,
}
_ON_FIELD = 4
"""Largest number of contacts that mujoco_warp keeps of a geom and a height field, of all triangles that touch."""
_UNBOUNDED = 1 << 30
"""Number that means "no bound": signed distance fields."""


def candidate_pairs(model: mujoco.MjModel, filtered: bool) -> NDArray[np.int64]:
    """Pairs of geoms allowed by collision masks or listed explicitly, the smaller id first, shape (P, 2).

    Args:
        filtered: also apply mujoco_warp's other filters: excluded bodies, parent and child, the same welded body.
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
    pairs = np.concatenate((np.stack((a[keep], b[keep]), axis=1), listed))
    return np.unique(pairs, axis=0).astype(np.int64).reshape(-1, 2)


def contacts_of(model: mujoco.MjModel, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Largest number of contacts of each pair, shape (P,); enormous if its types give no bound."""
    counts = np.full(model.ngeom, _UNBOUNDED, dtype=np.int64)
    for kind, count in _CONTACTS_PER_PAIR.items():
        counts[model.geom_type == kind] = count
    # For a plane, the other geom's type decides.
    plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    counts[plane] = 2 * _UNBOUNDED
    least = counts[pairs].min(axis=1) if len(pairs) else np.zeros(0, np.int64)
    both = counts[pairs].max(axis=1) if len(pairs) else least
    unbounded = both == _UNBOUNDED
    least = np.where(unbounded, _UNBOUNDED, least)
    counts_of_pairs = np.where(least == 2 * _UNBOUNDED, 0, least)
    fields = model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD
    return np.where(fields[pairs].any(axis=1), _ON_FIELD, counts_of_pairs)


def rows_per_contact(model: mujoco.MjModel, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Constraint rows of one contact of each pair, shape (P,)."""
    dims = model.geom_condim[pairs].max(axis=1).astype(np.int64) if len(pairs) else np.zeros(0, np.int64)
    place = {(int(a), int(b)): k for k, (a, b) in enumerate(pairs)}
    for a, b, dim in zip(model.pair_geom1, model.pair_geom2, model.pair_dim, strict=True):
        dims[place[min(int(a), int(b)), max(int(a), int(b))]] = dim
    if model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return np.where(dims == 1, 1, 2 * (dims - 1))
    return dims
