"""The mirror image of MyoSuite's walk: right and left exchanged in what its policy observes and does.

Axes: W worlds, U muscles, J joints but for the root.
"""

import mujoco
import numpy as np
import torch
from torch import Tensor

from msk_ray.errors import UnsupportedModelError
from msk_ray.legs.mirror import Mirror, other_side

_TOLERANCE = 2e-3
"""Largest difference between a length and that of its counterpart in the mirror image [m]."""
_SAMPLES = 3
_QUATERNION = ([3, 2, 1, 0], [-1.0, 1.0, 1.0, -1.0])
"""Of R' = diag(-1, 1, 1) R diag(1, -1, 1): the model walks along -y of the world, which is its root's x axis."""


class WalkMirror:
    """Exchanges sides in rows of MyoSuite's observations and actions.

    Args:
        model: MyoSuite's.
        device: where the rows are.

    Raises:
        UnsupportedModelError: the legs of this model are no mirror images.
    """

    def __init__(self, model: mujoco.MjModel, device: torch.device) -> None:
        joints = [model.joint(j).name for j in range(1, model.njnt)]
        muscles = [model.actuator(u).name for u in range(model.nu)]
        sides, pulls = other_side(joints), other_side(muscles)
        ranges = model.jnt_range[1:]
        # Some slides and hinges of the left knee run the other way: so do their ranges.
        flipped = np.abs(ranges + ranges[sides][:, ::-1]).sum(-1) < np.abs(ranges - ranges[sides]).sum(-1)
        signs = np.where(flipped, -1.0, 1.0).tolist()
        _check(model, sides, signs, pulls)
        ones = [1.0] * len(pulls)
        before = [
            ([0], [1.0]),
            _QUATERNION,
            (sides, signs),
            ([0, 1, 2], [-1.0, 1.0, 1.0]),
            ([0, 1, 2], [-1.0, 1.0, -1.0]),
            (sides, signs),
            ([0, 1], [-1.0, 1.0]),
            _QUATERNION,
            ([1, 0], [1.0, 1.0]),
            ([0], [1.0]),
            ([3, 4, 5, 0, 1, 2], [-1.0, 1.0, 1.0] * 2),
        ]
        self._phase = sum(len(places) for places, _ in before)
        self._observation = Mirror([*before, ([0], [1.0]), *[(pulls, ones)] * 4], device)
        self._action = Mirror([(pulls, ones)], device)
        self._half = torch.zeros(len(self._observation.places), device=device)
        self._half[self._phase] = 0.5

    def exchanged(self, obs: Tensor) -> Tensor:
        """Worlds (W,) bool whose phase is in its second half, by MyoSuite's observations (W, O)."""
        return obs[:, self._phase] >= 0.5

    def observation(self, obs: Tensor) -> Tensor:
        """What the policy observes (W, O): in the second half of the cycle the mirror image, half a cycle before."""
        return torch.where(self.exchanged(obs)[:, None], self._observation(obs) - self._half, obs)

    def action(self, exchanged: Tensor, action: Tensor) -> Tensor:
        """Actions (W, U) for the body as it is, with sides exchanged in these worlds (W,)."""
        return self._action.where(exchanged, action)


def _check(model: mujoco.MjModel, sides: list[int], signs: list[float], pulls: list[int]) -> None:
    rng = np.random.default_rng(0)
    low, high = model.jnt_range[1:].T
    tendons = model.actuator_trnid[:, 0]
    for _ in range(_SAMPLES):
        angles = low + (high - low) * rng.uniform(0.3, 0.7, len(low))
        lengths = []
        for values in (angles, angles[sides] * signs):
            data = mujoco.MjData(model)
            mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
            data.qpos[7:] = values
            mujoco.mj_fwdPosition(model, data)
            lengths.append(data.ten_length[tendons])
        error = np.abs(lengths[1][pulls] - lengths[0]).max()
        if error > _TOLERANCE:
            raise UnsupportedModelError(
                f"env.symmetric: the legs of this model are no mirror images (muscles {error * 1000:.0f} mm apart): "
                "write env.symmetric: false"
            )
