"""`BatchedEnv`: all worlds of an environment as one `gymnasium.vector.VectorEnv`.

Axes: W worlds, O observation, A action.
"""

from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, cast

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from msk_ray.config import Config
from msk_ray.envs import make_env
from msk_ray.errors import ConfigError
from msk_ray.gym.common import action_space, observation_space, read, refuse_options

Array = TypeVar("Array", np.ndarray, Tensor)


class BatchedEnv(VectorEnv[Array, Array, Array], Generic[Array]):
    """W worlds in MuJoCo Warp, on the CPU or a GPU, with the config's training reward and physics.

    A world whose episode ended is reset in the same step (`AutoresetMode.SAME_STEP`): the observation is then the first
    one of its next episode, and `infos["final_obs"]` (W, O) has the last one of the episode before, valid where
    `infos["_final_obs"]` (W,). `infos["diverged"]` (W,) says whether a world's physics diverged, which counts as
    terminated.

    Args:
        config: a config, its file, or its name in `configs/`.
        nworld: number of worlds; None: `env.nworld` of the config.
        device: "cpu", "cuda" or "cuda:N".
        arrays: "numpy", or "torch" for tensors on the device, which need no copy. Rewards are float32 either way.

    Raises:
        ConfigError, DeviceError, UnsupportedModelError: as their messages say.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012 - as in the base class

    def __init__(
        self,
        config: Config | str | Path,
        nworld: int | None = None,
        device: str = "cpu",
        arrays: Literal["numpy", "torch"] = "numpy",
    ) -> None:
        if arrays not in ("numpy", "torch"):
            raise ConfigError(f"arrays {arrays!r}: write numpy or torch")
        config = read(config)
        self.num_envs = config.env.nworld if nworld is None else nworld
        self._torch = arrays == "torch"
        self.env = make_env(
            config.env,
            config.physics,
            self.num_envs,
            device,
            config.trial.seed,
            differentiable=False,
            randomize=True,
            execution=config.execution,
        )
        self.single_observation_space = observation_space(self.env)
        self.single_action_space = action_space(self.env)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    @torch.no_grad()
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start a new episode in every world, drawn from `seed`, or else from the continued random stream.

        Raises:
            ConfigError: options are given; there are none.
        """
        refuse_options(options)
        if seed is not None:
            self.env.seed(seed)
        self.env.state = self.env.reset_state()
        return self._array(self.env.observation()), {}

    @torch.no_grad()
    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Step all worlds with actions (W, A), clipped to [-1, 1].

        Raises:
            SimulationError: contacts or constraint rows were lost to a full buffer.
        """
        given = torch.as_tensor(actions, dtype=torch.float32, device=self.env.device)
        if given.shape != (self.num_envs, self.env.action_size):
            raise ConfigError(
                f"actions have shape {tuple(given.shape)}, but {self.num_envs} worlds take "
                f"({self.num_envs}, {self.env.action_size})"
            )
        transition = self.env.step(given.clamp(-1.0, 1.0))
        # On a GPU a lost contact is known only after the step; without waiting, its worlds would look diverged.
        self.env.sim.settle()
        done = transition.terminated | transition.truncated
        infos = {
            "final_obs": self._array(transition.obs),
            "_final_obs": self._array(done),
            "diverged": self._array(transition.diverged),
        }
        results = (self.env.observation(), transition.reward, transition.terminated, transition.truncated)
        obs, reward, terminated, truncated = map(self._array, results)
        return obs, reward, terminated, truncated, infos

    def _array(self, value: Tensor) -> Array:
        # A copy, because on the CPU numpy shares the memory of tensors that later steps read again.
        return cast(Array, value.clone() if self._torch else value.cpu().numpy().copy())
