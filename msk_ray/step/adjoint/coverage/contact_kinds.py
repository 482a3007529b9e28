"""Which pairs of geoms may touch, and of which types."""

from collections.abc import Iterable

import mujoco

from msk_ray.step.adjoint.coverage.model_elements import Finder, named

_OBJ = mujoco.mjtObj
_GEOM = mujoco.mjtGeom


def types_of(first: Iterable[int], second: Iterable[int]) -> set[tuple[int, int]]:
    """Every pair of a first and a second type."""
    return {(int(a), int(b)) for a in first for b in second}


_SOLIDS = [
    *(_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_ELLIPSOID, _GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_BOX),
    _GEOM.mjGEOM_MESH,
]
FIELD_PAIRS = types_of([_GEOM.mjGEOM_HFIELD], _SOLIDS)
EXACT_PAIRS = types_of([_GEOM.mjGEOM_PLANE, *_SOLIDS], _SOLIDS)


def colliding_pairs(m: mujoco.MjModel) -> set[tuple[int, int]]:
    """Geom pairs that masks, parent filter and exclusions let through or that are listed, types in ascending order."""
    filtered = not m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    excluded = {int(s) for s in m.exclude_signature}

    def lets_through(a: int, b: int) -> bool:
        if not ((m.geom_contype[a] & m.geom_conaffinity[b]) or (m.geom_contype[b] & m.geom_conaffinity[a])):
            return False
        body1, body2 = sorted((int(m.geom_bodyid[a]), int(m.geom_bodyid[b])))
        weld1, weld2 = int(m.body_weldid[body1]), int(m.body_weldid[body2])
        if weld1 == weld2 or (body1 << 16) + body2 in excluded:
            return False
        parents = [int(m.body_weldid[m.body_parentid[w]]) for w in (weld1, weld2)]
        return not (filtered and weld1 and weld2 and (parents[0] == weld2 or parents[1] == weld1))

    pairs = {(int(a), int(b)) for a, b in zip(m.pair_geom1, m.pair_geom2, strict=True)}
    pairs |= {(a, b) for a in range(m.ngeom) for b in range(a + 1, m.ngeom) if lets_through(a, b)}
    return {(a, b) if m.geom_type[a] <= m.geom_type[b] else (b, a) for a, b in pairs}


def geom_pair_name(m: mujoco.MjModel, a: int, b: int) -> str:
    """Names of two geoms and their types."""
    names = named(m, _OBJ.mjOBJ_GEOM, "geom", (a, b))
    types = [mujoco.mjtGeom(m.geom_type[g]).name.removeprefix("mjGEOM_").lower() for g in (a, b)]
    return f"{names[0]} ({types[0]}) with {names[1]} ({types[1]})"


def pairs_of(kinds: set[tuple[int, int]] | None, known: set[tuple[int, int]]) -> Finder:
    """Pairs of the given types, or with None all those of no `known` type."""

    def find(m: mujoco.MjModel) -> list[str]:
        if m.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
            return []
        out = []
        for a, b in sorted(colliding_pairs(m)):
            types = (int(m.geom_type[a]), int(m.geom_type[b]))
            if (types in kinds) if kinds is not None else (types not in known):
                names = named(m, _OBJ.mjOBJ_GEOM, "geom", (a, b))
                out.append(f"{names[0]} with {names[1]}")
        return out

    return find


def contact_types(m: mujoco.MjModel) -> set[tuple[int, int]]:
    """Geom types, ascending, of the pairs that may touch."""
    if m.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
        return set()
    return {(int(m.geom_type[a]), int(m.geom_type[b])) for a, b in colliding_pairs(m)}
