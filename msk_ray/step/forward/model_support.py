"""Refuses models that mujoco_warp would silently step unlike C MuJoCo."""

from collections.abc import Callable, Iterable

import mujoco
import numpy as np
from numpy.typing import NDArray

from msk_ray.step.errors import UnsupportedModelError
from msk_ray.step.forward.geom_pairs import candidate_pairs

_OBJ = mujoco.mjtObj
_OFF = mujoco.mjtDisableBit
_SLIDING = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
_LEAST = float(mujoco.mjMINIMP), float(mujoco.mjMAXIMP)


def check_model_support(model: mujoco.MjModel) -> None:
    """Raise UnsupportedModelError, with advice, if mujoco_warp would step the model unlike C MuJoCo."""
    for check in (_state, _ignored_actuators, _plugins, _two_sides, _falling_impedances):
        check(model)


def _state(model: mujoco.MjModel) -> None:
    """Refuse state outside (qpos, qvel, act)."""
    hidden = {
        "actuator or sensor delay (nhistory > 0)": getattr(model, "nhistory", 0) > 0,
        "plastic springs (nplastic > 0)": getattr(model, "nplastic", 0) > 0,
        "sleeping (<flag sleep='enable'/>)": bool(model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP),
    }
    used = [name for name, present in hidden.items() if present]
    if used:
        raise UnsupportedModelError(
            f"the model uses {', '.join(used)}: its step depends on state outside (qpos, qvel, act); "
            "remove it from the model"
        )


def _ignored_actuators(model: mujoco.MjModel) -> None:
    groups = np.asarray(model.actuator_group)
    # C MuJoCo has one bit for each of 31 groups.
    off = [u for u in range(len(groups)) if 0 <= groups[u] < 31 and model.opt.disableactuator >> int(groups[u]) & 1]
    if off:
        raise UnsupportedModelError(
            f"actuator {_name(model, _OBJ.mjOBJ_ACTUATOR, off[0])} is in a group that option actuatorgroupdisable "
            "turns off, which mujoco_warp ignores: remove such actuators from the model"
        )


def _plugins(model: mujoco.MjModel) -> None:
    if model.nplugin:
        names = sorted({_name(model, _OBJ.mjOBJ_PLUGIN, i) for i in range(model.nplugin)})
        raise UnsupportedModelError(
            f"the model uses plugins (instance {', '.join(names)}), which mujoco_warp does not run: write shapes of "
            'signed distance fields as geoms of type="mesh" from files, and leave other plugins out'
        )


def _two_sides(model: mujoco.MjModel) -> None:
    """Refuse limits with both sides within their margin, because mujoco_warp makes a row for the nearer side only."""
    if model.opt.disableflags & (_OFF.mjDSBL_CONSTRAINT | _OFF.mjDSBL_LIMIT):
        return
    joints = (model.jnt_limited != 0) & np.isin(model.jnt_type, _SLIDING)
    for word, kind, limited, ranges, margins in (
        ("joint", _OBJ.mjOBJ_JOINT, joints, model.jnt_range, model.jnt_margin),
        ("tendon", _OBJ.mjOBJ_TENDON, model.tendon_limited != 0, model.tendon_range, model.tendon_margin),
    ):
        half = 0.5 * (ranges[:, 1] - ranges[:, 0])
        narrow = np.flatnonzero(limited & (margins > half))
        if len(narrow):
            i = narrow[0]
            raise UnsupportedModelError(
                f"the limits of {word} {_name(model, kind, i)} have a margin of {margins[i]:g}, above half of their "
                f"range ({half[i]:g}): mujoco_warp holds one side where C MuJoCo holds both; write a margin of at most "
                f"{half[i]:g}"
            )


def _falling_impedances(model: mujoco.MjModel) -> None:
    """Refuse dmin > dmax, because mujoco_warp clamps the impedance to [dmin, dmax]."""
    flags = model.opt.disableflags
    if flags & _OFF.mjDSBL_CONSTRAINT:
        return
    for off, setting, find in (
        (_OFF.mjDSBL_LIMIT, "solimplimit", _limits),
        (_OFF.mjDSBL_EQUALITY, "solimp", _equalities),
        (_OFF.mjDSBL_CONTACT, "solimp", _contacts),
    ):
        if flags & off:
            continue
        for name, solimp in find(model):
            raise UnsupportedModelError(
                f"the impedance of {name} falls with the violation ({setting} has dmin {solimp[0]:g} above dmax "
                f"{solimp[1]:g}), which mujoco_warp clamps and C MuJoCo does not: write dmin <= dmax, or a power of 1 "
                f"(the fifth number of {setting})"
            )


def _falls(solimp: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which rows of solimp (N, 5) would be clamped."""
    low, high = np.clip(solimp[:, 0], *_LEAST), np.clip(solimp[:, 1], *_LEAST)
    return np.asarray((low > high) & (solimp[:, 2] > mujoco.mjMINVAL) & (solimp[:, 4] > 1.0))


NamedImpedances = Iterable[tuple[str, NDArray[np.float64]]]


def _among(solimp: NDArray[np.float64], present: NDArray[np.bool_], name: Callable[[int], str]) -> NamedImpedances:
    solimp = np.asarray(solimp).reshape(-1, 5)
    return ((name(int(i)), solimp[i]) for i in np.flatnonzero(present & _falls(solimp)))


def _limits(model: mujoco.MjModel) -> NamedImpedances:
    yield from _among(
        model.jnt_solimp, model.jnt_limited != 0, lambda i: f"the limits of joint {_name(model, _OBJ.mjOBJ_JOINT, i)}"
    )
    yield from _among(
        model.tendon_solimp_lim,
        model.tendon_limited != 0,
        lambda i: f"the limits of tendon {_name(model, _OBJ.mjOBJ_TENDON, i)}",
    )


def _equalities(model: mujoco.MjModel) -> NamedImpedances:
    every = np.ones(model.neq, dtype=bool)
    return _among(model.eq_solimp, every, lambda i: f"equality {_name(model, _OBJ.mjOBJ_EQUALITY, i)}")


def _contacts(model: mujoco.MjModel) -> NamedImpedances:
    """Impedances of explicit pairs, and of other pairs that may touch, mixed as in MuJoCo."""
    name = lambda g: _name(model, _OBJ.mjOBJ_GEOM, g)  # noqa: E731
    listed = np.stack((model.pair_geom1, model.pair_geom2), axis=1)
    yield from _among(
        model.pair_solimp,
        np.ones(model.npair, dtype=bool),
        lambda i: f"contacts of geom {name(listed[i, 0])} with geom {name(listed[i, 1])}",
    )
    if not _falls(model.geom_solimp).any():
        return
    known = {(int(min(pair)), int(max(pair))) for pair in listed}
    for a, b in candidate_pairs(model, filtered=True):
        if (int(a), int(b)) in known:
            continue
        share = _share(model, int(a), int(b))
        solimp = share * model.geom_solimp[a] + (1.0 - share) * model.geom_solimp[b]
        if _falls(solimp[None])[0]:
            yield f"contacts of geom {name(a)} with geom {name(b)}", solimp


def _share(model: mujoco.MjModel, a: int, b: int) -> float:
    """Weight of geom a's parameters in its contacts with geom b, by priority and solmix (mj_contactParam)."""
    if model.geom_priority[a] != model.geom_priority[b]:
        return float(model.geom_priority[a] > model.geom_priority[b])
    one, other = (float(mix) if mix >= mujoco.mjMINVAL else 0.0 for mix in model.geom_solmix[[a, b]])
    return one / (one + other) if one + other else 0.5


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, i: int) -> str:
    return mujoco.mj_id2name(model, kind, int(i)) or str(int(i))
