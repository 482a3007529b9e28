"""A policy read from a checkpoint, without the means to train it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from msk_ray.algorithms import algorithm_class
from msk_ray.config import Config, parse_recorded
from msk_ray.envs import Env
from msk_ray.errors import CheckpointError
from msk_ray.training.checkpoint import load_checkpoint
from msk_ray.training.policy_group import Policy


@dataclass(frozen=True)
class SavedPolicy:
    """The deterministic policy of a checkpoint and the trial it comes from."""

    path: Path
    config: Config
    epoch: int
    env_steps: int
    sha256: str
    """Hash of the checkpoint's content, which identifies evaluations and pictures."""
    modules: dict[str, Any]
    """States of the policy's modules, by name; in a trial's full checkpoint, all modules of its algorithm."""

    def network(self, env: Env[Any]) -> nn.Module:
        """The policy's network on an environment's device.

        Raises:
            CheckpointError: it was trained on other observations or actions.
            ConfigError: its algorithm is not found, or not installed.
        """
        algorithm = algorithm_class(self.config)
        network = algorithm.policy_network(self.config, env.obs_size, env.action_size)
        try:
            for name, module in algorithm.policy_modules(network).items():
                module.load_state_dict(self.modules[name])
        except (KeyError, RuntimeError) as error:
            what = str(error).splitlines()[-1].strip()
            raise CheckpointError(
                f"{self.path} does not fit env {self.config.env.name} as it is now ({what}): use the commit it was "
                "written with"
            ) from error
        return network.to(env.device)

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
        config, epoch, env_steps, modules = (
            state["config"],
            state["epoch"],
            state["env_steps"],
            state["algorithm"]["modules"],
        )
    except (KeyError, TypeError) as error:
        raise CheckpointError(f"{path} holds no policy: {error} is missing") from error
    settings = parse_recorded(config, f"{path}: its settings")
    return SavedPolicy(path, settings, epoch, env_steps, facts["sha256"], modules)
