"""`SingleEnv`: one world of an environment in C MuJoCo as a `gymnasium.Env`."""

from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch

from msk_ray.config import Config
from msk_ray.envs import make_env
from msk_ray.errors import ConfigError
from msk_ray.gym.c_simulation import CSimulation
from msk_ray.gym.common import action_space, observation_space, read, refuse_options


class SingleEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One world in C MuJoCo on the CPU, with the reward and the physics that the config trains on.

    `info["diverged"]` says whether the physics diverged, which counts as terminated; `info["terms"]` has the
    weighted parts of the reward by name.

    Args:
        config: a config, its file, or its name in `configs/`.

    Raises:
        ConfigError: the config is invalid, or randomizes model parameters, which a single world does not support.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - as in the base class

    def __init__(self, config: Config | str | Path) -> None:
        config = read(config)
        if config.physics.randomize is not None:
            raise ConfigError(
                "physics.randomize: a single environment cannot randomize the model; set it to null, or use BatchedEnv"
            )
        self.env = make_env(
            config.env, config.physics, 1, "cpu", config.trial.seed, differentiable=False, execution=config.execution
        )
        batch = self.env.sim.batch
        self.env.sim = self._simulation = CSimulation(self.env.model, batch.substeps, batch.limits)
        for query in batch.contacts.queries:
            self._simulation.measure_contacts(query)
        self.observation_space = observation_space(self.env)
        self.action_space = action_space(self.env)
        self._begun = False

    @property
    def model(self) -> mujoco.MjModel:
        """The model."""
        return self.env.model

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's state after the last step; a reset appears in it with the next step."""
        return self._simulation.data

    @torch.no_grad()
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start a new episode, drawn from `seed`, or else from the continued random stream, which starts at a random
        seed.

        Raises:
            ConfigError: options are given.
        """
        super().reset(seed=seed)
        refuse_options(options)
        if seed is not None or not self._begun:
            self.env.seed(int(self.np_random.integers(2**31)))
            self._begun = True
        self.env.state = self.env.reset_state()
        return self.env.observation()[0].numpy().copy(), {}

    @torch.no_grad()
    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Step the world with an action (A,), clipped to [-1, 1]."""
        given = torch.as_tensor(action, dtype=torch.float32)
        if given.shape != self.action_space.shape:
            raise ConfigError(f"the action has shape {tuple(given.shape)}, not {self.action_space.shape}")
        transition = self.env.step(given[None].clamp(-1.0, 1.0), auto_reset=False)
        terms = dict(zip(self.env.reward_names, transition.terms[0].tolist(), strict=True))
        return (
            transition.obs[0].numpy().copy(),
            float(transition.reward[0]),
            bool(transition.terminated[0]),
            bool(transition.truncated[0]),
            {"terms": terms, "diverged": bool(transition.diverged[0])},
        )
