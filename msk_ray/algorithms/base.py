"""The interface between the trainer and an algorithm."""

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from msk_ray.algorithms.digest_log import DigestLog
from msk_ray.config import ALGORITHMS, AlgorithmSettings, Config, resolve_class
from msk_ray.config.packages import require
from msk_ray.envs import Env
from msk_ray.errors import ConfigError
from msk_ray.group import Group
from msk_ray.metrics import diagnostic, of_all_processes
from msk_ray.networks import parameter_hash


@dataclass(frozen=True)
class EpochResult:
    """The result of one epoch."""

    env_steps: int
    """Env steps simulated, all worlds together."""
    metrics: dict[str, float]
    """Figures for the logs, by name (`msk_ray.metrics`)."""
    episodes: int | None = None
    """Episodes that ended, all worlds together; None if the algorithm does not count them."""


class Algorithm(ABC):
    """Learns a policy for one environment, epoch by epoch.

    If its settings are `parallel`, it may run in several processes at once. Each has an environment with its share of
    the worlds, and they exchange gradients through the environment's `group`, so that all learn the same.

    A subclass needs `policy_network` and `update`; its settings, if it has any, are `Settings`. A resumed trial draws
    the same numbers from torch's global generator again.

    Attributes:
        config: the trial's config.
        settings: the algorithm's part of it, of type `Settings`.
        env: the worlds it trains in.
        network: the policy, on the environment's device.
        digest_log: records digests of what every stage of an epoch computes; None to record nothing.
    """

    digest_log: DigestLog | None = None
    Settings: ClassVar[type[AlgorithmSettings]] = AlgorithmSettings
    counts_episodes: ClassVar[bool] = False
    """Whether every epoch's result counts the episodes that ended; some environment settings need that count."""

    def __init__(self, config: Config, env: Env[Any], network: nn.Module | None = None) -> None:
        """
        Args:
            config: the trial's config.
            env: the worlds to train in.
            network: the policy; None creates a new `policy_network`.

        Raises:
            ConfigError: the algorithm does not support a setting.
        """
        if env.reads_episode_lengths and not self.counts_episodes:
            raise ConfigError(
                f"{env.reads_episode_lengths} needs an algorithm that counts the episodes that end, and "
                f"{config.algorithm.name} does not: write {env.reads_episode_lengths}: null, or return "
                "EpochResult(..., episodes=N) and set counts_episodes = True in its class"
            )
        torch.manual_seed(config.trial.seed)
        self.config = config
        self.settings: Any = config.algorithm_settings
        self.env = env
        made = self.policy_network(config, env.obs_size, env.action_size) if network is None else network
        self.network = made.to(env.device)

    @classmethod
    @abstractmethod
    def policy_network(cls, config: Config, obs_size: int, action_size: int) -> nn.Module:
        """A fresh policy: a module from raw observations (..., O) to deterministic actions (..., A) in [-1, 1]."""

    @abstractmethod
    def update(self, epoch: int) -> EpochResult:
        """Train one epoch, counted from 0.

        Raises:
            SimulationError: training cannot continue: a gradient is not finite, or the physics failed.
        """

    def run_epoch(self, epoch: int) -> EpochResult:
        """Tell the environment that an epoch begins, call `update`, and tell it that the epoch has ended.

        Raises:
            ConfigError: the algorithm has `counts_episodes`, but returned no count.
            SimulationError: as `update`.
        """
        self.env.enter_epoch(epoch)
        result = self.update(epoch)
        if self.counts_episodes and result.episodes is None:
            raise ConfigError(f"{type(self).__name__} has counts_episodes = True: return EpochResult(..., episodes=N)")
        length = None if result.episodes is None else result.env_steps / max(result.episodes, 1)
        return replace(result, metrics={**result.metrics, **self.env.end_epoch(length)})

    @classmethod
    def policy_modules(cls, network: nn.Module) -> dict[str, nn.Module]:
        """The parts of a policy that are saved, by name."""
        return {"policy": network}

    def modules(self) -> dict[str, nn.Module]:
        """Everything that is saved as a module, by name: the policy's parts and any others."""
        return self.policy_modules(self.network)

    @torch.no_grad()
    def policy(self, obs: Tensor) -> Tensor:
        """Deterministic actions (W, A) in [-1, 1] for raw observations (W, O), without gradients."""
        action: Tensor = self.network(obs)
        return action

    def remarks(self) -> list[str]:
        """Warnings to repeat when training ends: one line for each thing that makes it worse or slower."""
        return []

    def note_state(self) -> None:
        """Record digests of the worlds and of all saved modules, if there is a `digest_log`."""
        if self.digest_log is None:
            return
        state = self.env.state.detach()
        parts = {"action": state.action, "age": state.age, "numbers": state.numbers}
        memory = {f"memory {name}": values for name, values in state.memory.items()}
        self.digest_log.note("worlds", {**state.physics._asdict(), **parts, **memory})
        for name, module in self.modules().items():
            states = {key: value for key, value in module.state_dict().items() if isinstance(value, Tensor)}
            self.digest_log.note(f"module {name}", states)

    def parameter_hash(self) -> str:
        """Digest of everything that is saved as a module: 32 hexadecimal digits."""
        return parameter_hash({name: module.state_dict() for name, module in self.modules().items()})

    def state_dict(self) -> dict[str, Any]:
        """Everything that a later `load_state_dict` needs to continue exactly, including the environment's state.

        In a group, every process must call it.

        Raises:
            RuntimeError: the processes of the group hold different modules.
        """
        modules = {name: module.state_dict() for name, module in self.modules().items()}
        _check_equal(modules, self.env.group)
        state = {
            "modules": modules,
            "torch_generator": torch.get_rng_state(),
            **self.env.state_dict(),
        }
        if self.env.device.type == "cuda":
            state["torch_cuda_generator"] = torch.cuda.get_rng_state(self.env.device)
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        for name, module in self.modules().items():
            module.load_state_dict(state["modules"][name])
        # Generator states are host tensors, also for a GPU's generator. Older checkpoints have none, because SHAC
        # draws from its own generators.
        if "torch_generator" in state:
            torch.set_rng_state(state["torch_generator"].cpu())
        if "torch_cuda_generator" in state and self.env.device.type == "cuda":
            torch.cuda.set_rng_state(state["torch_cuda_generator"].cpu(), self.env.device)
        self.env.load_state_dict(state)

    def start_from(self, modules: Mapping[str, Any]) -> list[str]:
        """Take networks and statistics from another trial's states, by module name.

        Returns:
            Names of missing modules, such as the critic for a file with only a policy, which stay unchanged.

        Raises:
            KeyError: a module that the policy needs is missing.
            RuntimeError: a network has another shape.
        """
        needed, missing = self.policy_modules(self.network), []
        for name, module in self.modules().items():
            if name in modules or name in needed:
                module.load_state_dict(modules[name])
            else:
                missing.append(name)
        return missing


def _check_equal(modules: Mapping[str, Mapping[str, Tensor]], group: Group) -> None:
    if group.size == 1:
        return
    # Compare digests, because NaN does not equal itself.
    sums = {
        f"{name}.{key}": float(value.double().sum()).hex()
        for name, state in modules.items()
        for key, value in state.items()
    }
    for rank, others in enumerate(group.collect(sums)):
        for name, value in others.items():
            if value != sums[name]:
                raise RuntimeError(
                    f"{name} of process {rank} of the trial is not that of process {group.rank}: their gradients or "
                    "statistics were not averaged, or their GPUs are not of one kind"
                )


def algorithm_class(config: Config) -> type[Algorithm]:
    """The class of the algorithm that a trial runs.

    Raises:
        ConfigError: the name is unknown, or the class misses a method, takes settings of another type, or needs a
            package that is not installed.
    """
    require(config.algorithm_settings.packages, f"algorithm.name: {config.algorithm.name}")
    path = ALGORITHMS.path(config.algorithm.name)
    algorithm: type[Algorithm] = resolve_class(path, ALGORITHMS.key, Algorithm)  # type: ignore[type-abstract]
    if not isinstance(config.algorithm_settings, algorithm.Settings):
        wanted, given = (
            f"{algorithm.Settings.__module__}.{algorithm.Settings.__qualname__}",
            type(config.algorithm_settings),
        )
        raise ConfigError(f"algorithm.name: {path} takes settings of type {wanted}, not {given.__qualname__}")
    return algorithm


def simulation_metrics(env: Env[Any]) -> dict[str, float]:
    """The simulation's diagnostics since the last call, and the range of randomized parameters, by metric name.

    In a group, over all processes; every process must call it.

    Raises:
        SimulationError: contacts or constraint rows were lost to a full buffer.
    """
    drawn = {} if env.randomizer is None else env.randomizer.metrics(env.state.numbers[:, : env.randomizer.size])
    here = drawn | {diagnostic(name): value for name, value in env.sim.diagnostics().items()}
    every = env.group.collect(here)
    return {name: of_all_processes(name, [figures[name] for figures in every]) for name in here}


class Clock:
    """Measures how long each part of an epoch takes on the device; the host waits only when the times are read."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._names: list[str] = []
        self._times = [self._now()]

    def _now(self) -> "torch.cuda.Event | float":
        if self._device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self._device))
        return event

    def mark(self, name: str) -> None:
        """End the part that began at the previous mark, or when the clock was created."""
        self._names.append(name)
        self._times.append(self._now())

    def seconds(self) -> dict[str, float]:
        """Seconds of each part by name; waits until the device has finished the last one."""
        return {
            name: self._between(before, after)
            for name, before, after in zip(self._names, self._times[:-1], self._times[1:], strict=True)
        }

    @staticmethod
    def _between(before: "torch.cuda.Event | float", after: "torch.cuda.Event | float") -> float:
        if isinstance(before, float) or isinstance(after, float):
            assert isinstance(before, float), "marks of one clock are of one kind"
            assert isinstance(after, float), "marks of one clock are of one kind"
            return after - before
        after.synchronize()
        return float(before.elapsed_time(after)) * 1e-3
