"""The mirror image of what a policy observes and does: right and left exchanged.

Axes: O observation, A action.
"""

import re
from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from msk_ray.errors import UnsupportedModelError

_TOLERANCE = 2e-3
"""Largest distance between a body and the mirror image of its counterpart [m]."""
_SAMPLES = 4
_SIDE = re.compile(r"_([rl])(?=_|$)")


class Mirror:
    """Exchanges sides: `y = x[:, places] * signs`.

    Args:
        parts: places within each part of a row, and their signs, in order.
        device: where the rows are.
    """

    def __init__(self, parts: Sequence[tuple[Sequence[int], Sequence[float]]], device: torch.device) -> None:
        places: list[int] = []
        signs: list[float] = []
        first = 0
        for order, part_signs in parts:
            places += [first + place for place in order]
            signs += part_signs
            first += len(order)
        self.places = torch.tensor(places, device=device)
        self.signs = torch.tensor(signs, dtype=torch.float32, device=device)

    def __call__(self, rows: Tensor) -> Tensor:
        """The mirror image of rows (W, n)."""
        return rows[:, self.places] * self.signs

    def where(self, chosen: Tensor, rows: Tensor) -> Tensor:
        """Rows (W, n), mirrored in the chosen worlds (W,)."""
        return torch.where(chosen[:, None], self(rows), rows)


def other_side(names: Sequence[str]) -> list[int]:
    """For each name its counterpart's place in the list, by the first _r or _l in it; others are their own.

    Raises:
        UnsupportedModelError: there is no counterpart.
    """
    found = []
    for name in names:
        swapped = _SIDE.sub(lambda side: "_l" if side[1] == "r" else "_r", name, count=1)
        if swapped not in names:
            raise UnsupportedModelError(
                f"env.symmetric: {name} has no counterpart {swapped}: write env.symmetric: false"
            )
        found.append(list(names).index(swapped))
    return found


def leg_mirrors(
    pose_signs: Sequence[float], hinges: Sequence[str], muscles: Sequence[str], device: torch.device
) -> tuple[Mirror, Mirror]:
    """The mirror images of a leg environment's observations and actions.

    Args:
        pose_signs: of the pose of the pelvis.
        hinges: names of the joints of the legs.
        muscles: names of the actions.
        device: where they are needed.

    Raises:
        UnsupportedModelError: a joint or a muscle has no counterpart.
    """
    sides, pulls = other_side(hinges), other_side(muscles)
    vector = [0, 1, 2]
    parts: list[tuple[Sequence[int], Sequence[float]]] = [([0], [1.0]), (range(len(pose_signs)), pose_signs)]
    # A velocity's left is reversed; of an angular velocity everything else is.
    parts += [(vector, [1.0, -1.0, 1.0]), (vector, [-1.0, 1.0, -1.0])]
    parts += [(sides, [1.0] * len(sides))] * 2
    parts += [(pulls, [1.0] * len(pulls))] * 5
    # The target speed, and the clock, which the exchange of sides turns by half a cycle.
    parts += [([0], [1.0]), ([0, 1], [-1.0, -1.0])]
    return Mirror(parts, device), Mirror([(pulls, [1.0] * len(pulls))], device)


def check_mirrored(model: mujoco.MjModel, hinges: Sequence[int], axes: np.ndarray) -> None:
    """Check that angles exchanged between the sides give the mirror image of the legs, in a few poses.

    Args:
        model: with a keyframe `stand`.
        hinges: joints of the legs.
        axes: forward, left and up, rows in the world, (3, 3).

    Raises:
        UnsupportedModelError: they do not.
    """
    names = [model.joint(j).name for j in hinges]
    places = other_side(names)
    every = [model.body(b).name for b in range(model.nbody)]
    own = [name for name in every if name[:-1] + {"r": "l", "l": "r"}.get(name[-1:], "") in every]
    other = [own.index(name[:-1] + {"r": "l", "l": "r"}[name[-1]]) for name in own]
    bodies = [every.index(name) for name in own]
    pelvis = model.body("pelvis").id
    rng = np.random.default_rng(0)
    addresses = model.jnt_qposadr[list(hinges)]
    low, high = model.jnt_range[list(hinges)].T
    for _ in range(_SAMPLES):
        angles = low + (high - low) * rng.uniform(0.3, 0.7, len(hinges))
        seen = []
        for values in (angles, angles[places]):
            data = mujoco.MjData(model)
            mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
            data.qpos[addresses] = values
            mujoco.mj_kinematics(model, data)
            seen.append((data.xpos[bodies] - data.xpos[pelvis]) @ axes.T)
        error = np.abs(seen[1][other] * [1.0, -1.0, 1.0] - seen[0]).max()
        if error > _TOLERANCE:
            raise UnsupportedModelError(
                f"env.symmetric: the legs of this model are no mirror images ({error * 1000:.0f} mm apart): write "
                "env.symmetric: false"
            )
