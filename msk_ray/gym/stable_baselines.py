"""`BatchedEnv` with the interface of Stable-Baselines3."""

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from msk_ray.config import Config
from msk_ray.gym.batched import BatchedEnv


class StableBaselinesEnv(VecEnv):
    """All worlds of an environment for Stable-Baselines3: `PPO("MlpPolicy", StableBaselinesEnv("cartpole"))`.

    Args:
        config, nworld, device: as for `BatchedEnv`.

    Raises:
        ConfigError, DeviceError, UnsupportedModelError: as for `BatchedEnv`.
    """

    def __init__(self, config: Config | str | Path, nworld: int | None = None, device: str = "cpu") -> None:
        self.batched: BatchedEnv[np.ndarray] = BatchedEnv(config, nworld, device)
        self._actions = np.zeros(self.batched.action_space.shape or (), np.float32)
        super().__init__(self.batched.num_envs, self.batched.single_observation_space, self.batched.single_action_space)

    def reset(self) -> np.ndarray:
        """Observations (W, O) of new episodes, drawn from the first seed given to `seed`, if any."""
        obs, _ = self.batched.reset(seed=self._seeds[0])
        self._reset_seeds()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Store actions (W, A) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations, rewards, ends of episodes, and a dictionary per world, with `terminal_observation` and
        `TimeLimit.truncated` if its episode ended."""
        obs, reward, terminated, truncated, infos = self.batched.step(self._actions)
        done = terminated | truncated
        details: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(done):
            details[world] = {
                "terminal_observation": infos["final_obs"][world],
                "TimeLimit.truncated": bool(truncated[world]),
            }
        return obs, reward, done, details

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the batched environment, repeated for each world asked for."""
        value = getattr(self.batched, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Worlds have no own attributes to set.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("worlds of a batch have no own attributes: set those of `batched`")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Worlds have no own methods to call.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("worlds of a batch have no own methods: call those of `batched`")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No world is wrapped."""
        return [False for _ in self._get_indices(indices)]
