"""Pushes in training, drawn at random: sudden changes of velocity.

Axes: W worlds.
"""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import mujoco
import torch
from torch import Tensor

from msk_ray.config import Push
from msk_ray.envs.commands import Draws
from msk_ray.errors import ConfigError
from msk_ray.step import StepState

if TYPE_CHECKING:
    from msk_ray.envs.base import Env


class Pushes:
    """The pushes of a setting. When each comes and how large it is are drawn like a command that changes within an
    episode.

    Attributes:
        size: count of the numbers of an episode.

    Raises:
        ConfigError: the model has no such joint, or the joint has another number of velocities.
    """

    def __init__(self, push: Push, env: "Env[Any]") -> None:
        self._step_s = env.config.control_timestep
        dofs = dict(_pushed_dofs(push, env.model))
        times = math.ceil(env.config.episode_length * self._step_s / push.every[0])
        self.size = times * (len(dofs) + 1)
        self._draws = Draws(slice(0, self.size), times, push.every)
        self._dofs = torch.tensor(list(dofs), dtype=torch.int64, device=env.device)
        largest = torch.tensor(list(dofs.values()), device=env.device)
        self._ranges = torch.stack((-largest, largest))

    def applied(self, state: StepState, age: Tensor, drawn: Tensor) -> StepState:
        """The state at an age [env steps], (W,), after its push, if any, from the drawn numbers (W, size)."""
        before, now = ((steps * self._step_s) for steps in (age - 1, age))
        begins = self._draws.times_drawn(drawn, now) > self._draws.times_drawn(drawn, before)
        change = self._draws.value(drawn, now, self._ranges) * begins[:, None]
        return state._replace(qvel=state.qvel.index_add(1, self._dofs, change))


def _pushed_dofs(push: Push, model: mujoco.MjModel) -> Iterator[tuple[int, float]]:
    """Numbers of the degrees of freedom that are pushed, and the largest change of the velocity of each."""
    key, joints = "physics.randomize.push.velocity", [model.joint(i).name or str(i) for i in range(model.njnt)]
    for name, largest in push.velocity.items():
        if name not in joints:
            raise ConfigError(f"{key}: the model has no joint {name!r}; it has {', '.join(joints) or 'none'}")
        joint = joints.index(name)
        first = int(model.jnt_dofadr[joint])
        size = int((model.dof_jntid == joint).sum())
        if len(largest) != size:
            raise ConfigError(
                f"{key}.{name}: write {size} numbers, one for each velocity of the joint, not {len(largest)}"
            )
        yield from zip(range(first, first + size), largest, strict=True)
