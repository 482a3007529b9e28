"""A trial's worlds and algorithm, in its leading process and in the following ones."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from msk_ray.algorithms import Algorithm, algorithm_class
from msk_ray.config import Config
from msk_ray.envs import make_env
from msk_ray.errors import CheckpointError
from msk_ray.group import ALONE, Group
from msk_ray.training.checkpoint import read_checkpoint
from msk_ray.training.determinism import use_determinism
from msk_ray.training.named_out_of_memory import named_out_of_memory
from msk_ray.training.threads import use_threads


def make_algorithm(config: Config, device: str, group: Group = ALONE) -> Algorithm:
    """A trial's algorithm before training, in this process's worlds.

    Raises:
        ConfigError, DeviceError, UnsupportedModelError: as their messages say.
    """
    algorithm = algorithm_class(config)
    use_threads(config)
    use_determinism(config, device)
    env = make_env(
        config.env,
        config.physics,
        config.env.nworld // group.size,
        device,
        config.trial.seed,
        differentiable=config.algorithm_settings.differentiates,
        randomize=True,
        execution=config.execution,
    )
    if group.size > 1:
        env.join(group)
    if config.env.spread_resets:
        env.spread_ages()
    return algorithm(config, env)


def memory_errors_named(config: Config, device: str) -> AbstractContextManager[None]:
    """Context that turns out-of-memory errors into ones that name the settings to lower."""
    length = config.algorithm_settings.length
    other = [] if length is None else [f"{config.algorithm_section}.{length}"]
    worlds = config.env.nworld // config.execution.gpus
    return named_out_of_memory(device, worlds, "env.nworld", *other)


def start_from(algorithm: Algorithm, path: str) -> list[str]:
    """Give an algorithm the networks and statistics of another trial's checkpoint.

    Returns:
        Names of modules that are not in the checkpoint and start untrained.

    Raises:
        CheckpointError: it is missing, incomplete, or does not fit.
    """
    try:
        state = read_checkpoint(Path(path))
    except CheckpointError as error:
        raise CheckpointError(
            f"trial.start_from: {error}; train that policy first, or write the path of another"
        ) from error
    try:
        return algorithm.start_from(_to_device(state["algorithm"]["modules"], algorithm.env.device))
    except (KeyError, TypeError, RuntimeError) as error:
        what = str(error).splitlines()[-1].strip()
        raise CheckpointError(
            f"trial.start_from: {path} does not fit this trial ({what}): give a checkpoint of the same env, algorithm "
            "and networks"
        ) from error


def check_generators(path: Path, saved: Tensor, device: torch.device) -> None:
    """Raise if generator states come from another kind of device: they do not fit, and draw other numbers."""
    if len(saved) == len(torch.Generator(device=device).get_state()):
        return
    there, here, option = ("CPU", "GPU", "cpu") if device.type == "cuda" else ("GPU", "CPU", "cuda:0")
    raise CheckpointError(
        f"{path} was written on a {there}, and a {here} draws other random numbers; use --device {option}, or begin "
        f"another trial with its networks: --set trial.start_from={path}"
    )


def load_state(algorithm: Algorithm, checkpoint: Mapping[str, Any]) -> None:
    """Let an algorithm continue from a trial's checkpoint."""
    algorithm.load_state_dict(_to_device(checkpoint["algorithm"], algorithm.env.device))


def _to_device(value: Any, device: Any) -> Any:
    """Nested containers with every tensor moved to a device."""
    if isinstance(value, dict):
        return {k: _to_device(v, device) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_to_device(v, device) for v in value]
    return value.to(device) if hasattr(value, "to") else value


def follow(config: Config, device: str, group: Group) -> None:
    """Train this process's share of a trial's worlds, following the group's first process until it says stop.

    The first process runs a `Trainer`, and announces every call in which all processes take part.

    Raises:
        ConfigError, DeviceError, UnsupportedModelError, SimulationError, CheckpointError: as their messages say.
    """
    with memory_errors_named(config, device):
        algorithm = make_algorithm(config, device, group)
        while order := group.receive_order():
            match order:
                case ("start_from", path):
                    start_from(algorithm, path)
                case ("load", path):
                    load_state(algorithm, read_checkpoint(Path(path)))
                case ("update", epoch):
                    algorithm.run_epoch(epoch)
                case ("state_dict",):
                    algorithm.state_dict()  # takes part in gathering it
                case _:
                    raise AssertionError(f"unknown order {order}")
