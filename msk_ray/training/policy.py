"""A policy read from a checkpoint, for inference only."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from msk_ray.algorithms import algorithm_class
from msk_ray.config import Config, parse_recorded
from msk_ray.envs import Env
from msk_ray.errors import CheckpointError
from msk_ray.training.checkpoint import load_checkpoint
from msk_ray.training.policy_group import Policy

Batch = TypeVar("Batch", Tensor, np.ndarray)


class Sizes(NamedTuple):
    """A policy's input and output sizes."""

    obs: int
    action: int


@dataclass(frozen=True)
class SavedPolicy:
    """The deterministic policy of a checkpoint and the trial it comes from.

    `policy(obs)` returns actions (..., A) in [-1, 1] for raw observations (..., O), without gradients: a tensor for a
    tensor, an array for an array.
    """

    path: Path
    config: Config
    epoch: int
    env_steps: int
    sha256: str
    """Hash of the checkpoint's content; evaluations and pictures are stored under it."""
    modules: dict[str, Any]
    """States of the policy's modules, by name; in a trial's full checkpoint, all modules of its algorithm."""
    sizes: Sizes
    """Sizes of observation and action."""

    @torch.no_grad()
    def __call__(self, obs: Batch) -> Batch:
        """Actions (..., A) for raw observations (..., O).

        Raises:
            CheckpointError: the observations have another size.
            ConfigError: its algorithm is not found, or not installed.
        """
        size = self.sizes.obs
        if obs.shape[-1] != size:
            raise CheckpointError(f"{self.path} takes observations of size {size}, not {obs.shape[-1]}")
        given = torch.as_tensor(obs, dtype=torch.float32)
        action: Tensor = self._standalone.to(given.device)(given)
        return action if isinstance(obs, Tensor) else action.numpy()

    @cached_property
    def _standalone(self) -> nn.Module:
        return self._network(self.sizes)

    def network(self, env: Env[Any]) -> nn.Module:
        """The policy's network on an environment's device.

        Raises:
            CheckpointError: it was trained on other observations or actions.
            ConfigError: its algorithm is not found, or not installed.
        """
        return self._network(Sizes(env.obs_size, env.action_size)).to(env.device)

    def _network(self, sizes: Sizes) -> nn.Module:
        algorithm = algorithm_class(self.config)
        network = algorithm.policy_network(self.config, *sizes)
        try:
            for name, module in algorithm.policy_modules(network).items():
                module.load_state_dict(self.modules[name])
        except (KeyError, RuntimeError) as error:
            what = str(error).splitlines()[-1].strip()
            raise CheckpointError(
                f"{self.path} does not fit env {self.config.env.name} as it is now ({what}): use the commit it was "
                "written with"
            ) from error
        return network

    def on(self, env: Env[Any]) -> Policy:
        """The policy on an environment's device: raw observations (W, O) to actions (W, A), without gradients.

        Raises:
            CheckpointError, ConfigError: as for `network`.
        """
        network = self.network(env)

        @torch.no_grad()
        def policy(obs: Tensor) -> Tensor:
            action: Tensor = network(obs)
            return action

        return policy


def load_policy(path: str | Path) -> SavedPolicy:
    """Read the policy in a checkpoint, on CPU.

    Raises:
        CheckpointError: the checkpoint is missing, incomplete, of another format, or holds no policy.
        ConfigError: this version does not know its settings.
    """
    path = Path(path)
    facts, state = load_checkpoint(path)
    try:
        config, epoch, env_steps = (state[name] for name in ("config", "epoch", "env_steps"))
        sizes, modules = Sizes(*state["sizes"]), state["algorithm"]["modules"]
    except (KeyError, TypeError) as error:
        raise CheckpointError(f"{path} holds no policy: {error} is missing") from error
    settings = parse_recorded(config, f"{path}: its settings")
    return SavedPolicy(path, settings, epoch, env_steps, facts["sha256"], modules, sizes)
