"""Which geom's sliding friction counts in a contact, and what drawing that of some geoms can change."""

from collections.abc import Collection

import mujoco
import numpy as np
from numpy.typing import NDArray

from msk_ray.config import Draw
from msk_ray.step.forward.geom_pairs import candidate_pairs


def friction_without_effect(model: mujoco.MjModel, draw: Draw, chosen: Collection[int]) -> str | None:
    """Why a number drawn for the sliding friction of geoms would change nothing, with what to write; None if it would.

    As in MuJoCo, a contact has the friction and the dimension of the geom of higher priority, or of equal ones the
    larger of both, and a listed pair has its own.

    Args:
        model: the model.
        draw: what is drawn.
        chosen: ids of the geoms that it is drawn for.
    """
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or str(geom) for geom in range(model.ngeom)]
    pairs = _unlisted_pairs(model)
    if not len(pairs) and model.npair:
        return "the model's contacts are pairs, which have their own friction; write pair_friction instead"
    own = model.geom_friction[:, 0]
    low, high = own.copy(), own.copy()
    for geom in chosen:
        factor = own[geom] if draw.mode == "scale" else 1.0
        low[geom], high[geom] = draw.low * factor, draw.high * factor
    # With `each`, every geom has a number of its own; of all geoms, only some need collide.
    apart = draw.each and draw.only is not None
    numbers = [{geom} for geom in chosen] if draw.each else [set(chosen)]
    obstacles = [_obstacle(model, names, pairs, number, (low, high)) for number in numbers]
    reasons = [obstacle for obstacle in obstacles if obstacle is not None]
    return reasons[0] if reasons and (apart or len(reasons) == len(obstacles)) else None


def _obstacle(
    model: mujoco.MjModel,
    names: list[str],
    pairs: NDArray[np.int64],
    together: set[int],
    bounds: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> str | None:
    """Why no contact depends on the number that some geoms have together; None if one does."""
    low, high = bounds
    why = None
    for geom, other in [*pairs.tolist(), *pairs[:, ::-1].tolist()]:
        if geom not in together:
            continue
        ahead = int(model.geom_priority[geom]) - int(model.geom_priority[other])
        dims = model.geom_condim[[geom, other]]
        frictionless = (dims.max() if ahead == 0 else dims[0 if ahead > 0 else 1]) == 1
        if ahead < 0 and other not in together:
            why = f"geom {names[other]!r} has priority over {names[geom]!r}, so that its own friction counts; draw that"
        elif frictionless:
            why = why or f"contacts of {names[geom]!r} and {names[other]!r} have no friction (condim 1); leave it out"
        elif ahead == 0 and other not in together and high[geom] <= low[other]:
            why = why or (
                f"of two geoms in contact the larger friction counts, that of {names[other]!r}, at least "
                f"{low[other]:g}, over that of {names[geom]!r}, at most {high[geom]:g}; draw that of both"
            )
        else:
            return None
    if why is None:
        colliding = ", ".join(names[geom] for geom in np.unique(pairs)) or "none"
        which = ", ".join(names[geom] for geom in sorted(together))
        why = f"no contact reads the friction of {which}; geoms whose contacts do: {colliding}"
    return why


def _unlisted_pairs(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Pairs of geoms (P, 2) that collide with the friction of geoms."""
    listed = {tuple(sorted(pair)) for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)}
    pairs = candidate_pairs(model, filtered=True)
    keep = [tuple(pair) not in listed for pair in pairs.tolist()]
    return pairs[keep].reshape(-1, 2)
