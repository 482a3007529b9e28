"""Springs that hold the pelvis up during training, and how much of them is left.

Axes: W worlds.
"""

import math
from collections.abc import Mapping
from typing import Any, Generic, TypeVar

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msk_ray.config import EnvSettings
from msk_ray.envs.base import Env
from msk_ray.legs.config import AssistConfig
from msk_ray.step import StepState
from msk_ray.step.autograd.tangent import quat_conjugate, quat_log, quat_multiply

AnySettings = TypeVar("AnySettings", bound=EnvSettings)

RIGHTING = 800.0
"""Righting torque of tilt and list [N m/rad]; that of rotation is smaller in proportion to its inertia."""
LATERAL = 800.0
"""Force towards the walking line [N/m]."""
_TRUNK_INERTIA = (7.0, 7.0, 0.85)
"""About the forward, left and up axes [kg m²] of myoleg26's pelvis and trunk with hanging legs: what the springs
turn."""


class Assistance:
    """Share of the springs' stiffness, which falls with the epochs that count.

    Args:
        config: the schedule.
        timestep: of a control step [s].
        device: of `share`.

    Attributes:
        share: a number on the device, changed in place.
        reads_episode_lengths: the setting, if any, because of which `end_epoch` needs the length.
    """

    def __init__(self, config: AssistConfig, timestep: float, device: torch.device) -> None:
        self._config = config
        self._timestep = timestep
        self._passed = 0
        self.reads_episode_lengths = "env.assist.steady" if config.epochs and config.steady is not None else None
        self.share = torch.tensor(config.at(0), device=device)

    def begin_epoch(self, epoch: int) -> None:
        """Set the share of an epoch, counted from 0."""
        if self._config.steady is None:
            self._passed = epoch
        self.share.fill_(self._config.at(self._passed))

    def end_epoch(self, length: float | None) -> dict[str, float]:
        """Count an epoch that had this many env steps per episode that ended; its share, by metric name.

        With `steady`, the length must be known (`Env.reads_episode_lengths`).
        """
        if not self._config.epochs:
            return {}
        stood = self._config.at(self._passed)
        if self._config.steady is not None:
            assert length is not None
            self._passed += length * self._timestep >= self._config.steady
        return {"train/assist": stood}

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` needs."""
        return {} if self._config.steady is None else {"assist_epochs": self._passed}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        if self._config.steady is not None:
            self._passed = state["assist_epochs"]


class FreeSprings:
    """Springs and critical dampers at full strength on a pelvis that is a free joint, the first of its model.

    They turn it to its orientation in the keyframe `stand`, and pull it onto the line that leads forward from there.
    Forward, left and up are the rows of `axes` (3, 3) in the world.
    """

    def __init__(self, model: mujoco.MjModel, axes: NDArray[np.float64], device: torch.device) -> None:
        stand = model.key("stand").qpos

        def tensor(values: object) -> Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=device)

        self._local, self._stand = tensor(in_root(model, axes)), tensor(stand[3:7])
        self._righting, self._turning = map(tensor, righting())
        mass = float(model.body_subtreemass[0])
        self._lateral_damping = 2.0 * math.sqrt(LATERAL * mass)
        self._left, self._rest = tensor(axes[1]), float(stand[:3] @ axes[1])

    def force(self, state: StepState) -> Tensor:
        """Forces on the degrees of freedom [N, N m], (W, nv)."""
        q, v = state.qpos, state.qvel
        aside, drift = (q[:, :3] * self._left).sum(-1) - self._rest, (v[:, :3] * self._left).sum(-1)
        push = -(LATERAL * aside + self._lateral_damping * drift)
        # Forces on a free joint's rotation are in the body's frame, as its velocity is.
        error = quat_multiply(quat_conjugate(self._stand.expand(len(q), 4)), q[:, 3:7])
        along, spin = quat_log(error) @ self._local.T, v[:, 3:6] @ self._local.T
        torque = -(self._righting * along + self._turning * spin) @ self._local
        root = torch.cat((push[:, None] * self._left, torque), dim=-1)
        return torch.nn.functional.pad(root, (0, v.shape[1] - 6))


def righting() -> tuple[list[float], list[float]]:
    """Stiffness [N m/rad] and critical damping, 2 √(k m), [N m s/rad] about the forward, left and up axes.

    The frequency is the same about all three; otherwise the light one would oscillate within a control step.
    """
    stiffness = [RIGHTING * inertia / _TRUNK_INERTIA[0] for inertia in _TRUNK_INERTIA]
    return stiffness, [2.0 * math.sqrt(k * inertia) for k, inertia in zip(stiffness, _TRUNK_INERTIA, strict=True)]


def in_root(model: mujoco.MjModel, axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axes of the world, rows (3, 3), in the frame that the free root has in the keyframe `stand`."""
    start = np.zeros(9)
    mujoco.mju_quat2Mat(start, model.key("stand").qpos[3:7])
    return axes @ start.reshape(3, 3)


class AssistedEnv(Env[AnySettings], Generic[AnySettings]):
    """An environment with springs that fade.

    Attributes:
        assistance: how much is left of them; to be set in `prepare`.
    """

    assistance: Assistance

    @property
    def reads_episode_lengths(self) -> str | None:
        return self.assistance.reads_episode_lengths

    def apply_schedules(self, epoch: int) -> None:
        super().apply_schedules(epoch)
        self.assistance.begin_epoch(epoch)

    def end_epoch(self, length: float | None) -> dict[str, float]:
        return self.assistance.end_epoch(length)

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), **self.assistance.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self.assistance.load_state_dict(state)
