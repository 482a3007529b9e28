"""Devices of trials: GPUs if there are any, unless requested otherwise."""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from msk_ray.config import Config
from msk_ray.errors import ConfigError, DeviceError
from msk_ray.sweep.space import ResourcesSpec

_PAUSE_S = 1.0


@dataclass(frozen=True)
class Placement:
    """Resources of one trial."""

    gpus: float
    cpus: int

    @property
    def device(self) -> str:
        """Device name inside the trial's process, which sees only its own GPUs."""
        return "cuda:0" if self.gpus else "cpu"

    def concurrent(self, total_gpus: float, total_cpus: float, limit: int | None) -> int:
        """Number of trials that fit at the same time, at least one."""
        # A trial cannot combine leftover shares of several GPUs.
        if self.gpus >= 1:
            by_gpu = total_gpus // self.gpus
        else:
            # The tolerance is for rounding: 1 // 0.2 is 4.
            by_gpu = total_gpus * int(1 / self.gpus + 1e-6) if self.gpus else float("inf")
        fitting = max(1, int(min(by_gpu, total_cpus // self.cpus)))
        return fitting if limit is None else min(fitting, limit)


def choose_placement(
    resources: ResourcesSpec, gpus_per_trial: float | None, cpu: bool, gpus: int, processes: int = 1
) -> Placement:
    """Decide what each trial runs on.

    Args:
        resources: the space's section.
        gpus_per_trial: --gpus-per-trial, if given.
        cpu: whether --cpu is given.
        gpus: number of GPUs available; for trials with several GPUs, on one host.
        processes: `execution.gpus` of the trials.

    Raises:
        ConfigError: the request is contradictory.
        DeviceError: there are not enough GPUs.
    """
    if gpus_per_trial is not None:
        if cpu:
            raise ConfigError("--cpu and --gpus-per-trial exclude each other")
        if not (0 < gpus_per_trial <= 1 or gpus_per_trial % 1 == 0 < gpus_per_trial):  # NaN is neither
            raise ConfigError(f"--gpus-per-trial {gpus_per_trial:g}: write 1, 2, ... or a share such as 0.5")
        if gpus == 0:
            raise DeviceError(f"--gpus-per-trial {gpus_per_trial:g}: there is no GPU; pass --cpu to run on CPUs")
    cpus = processes * resources.cpus_per_trial
    if cpu or gpus == 0:
        return Placement(0.0, cpus)
    wanted = resources.gpus_per_trial if gpus_per_trial is None else gpus_per_trial
    if gpus_per_trial is None and wanted == 1.0:
        wanted = float(processes)
    if wanted > gpus:
        raise DeviceError(f"{wanted:g} GPUs per trial requested, but there are {gpus}")
    if wanted != processes and max(wanted, processes) > 1:
        raise ConfigError(
            f"{wanted:g} GPUs per trial, but execution.gpus is {processes}: leave out --gpus-per-trial and "
            "resources.gpus_per_trial, and set execution.gpus alone"
        )
    return Placement(wanted, cpus)


def processes_of(configs: Iterable[Config]) -> int:
    """`execution.gpus` of an experiment's trials.

    Raises:
        ConfigError: it differs between trials.
    """
    counts = sorted({config.execution.gpus for config in configs})
    if len(counts) > 1:
        raise ConfigError(
            f"execution.gpus is {' and '.join(map(str, counts))}: all trials of an experiment have the same "
            "number; start an experiment for each"
        )
    return counts[0] if counts else 1


def check_threads(configs: Iterable[Config], resources: ResourcesSpec) -> None:
    """Raise if trials use more threads than they have cores.

    Raises:
        ConfigError: the message says what to write.
    """
    most = max((config.execution.threads for config in configs), default=1)
    if most > resources.cpus_per_trial:
        raise ConfigError(
            f"execution.threads {most}, {resources.cpus_per_trial} cores per trial: write "
            f"resources.cpus_per_trial: {most}"
        )


def wait_for_memory(
    share: float, free_share: Callable[[], float], limit_s: float, pause: Callable[[float], None] = time.sleep
) -> float | None:
    """Wait until a dead process's GPU memory is free, which takes drivers some seconds.

    Args:
        share: the trial's share of the GPU's memory.
        free_share: returns the share of the memory that is free now.
        limit_s: how long to wait [s].
        pause: sleeps for a number of seconds.

    Returns:
        None once nearly all of `share` is free; otherwise the share that is free after `limit_s`.
    """
    for _ in range(math.ceil(limit_s / _PAUSE_S)):
        # Every process needs a few hundred megabytes for its own CUDA context.
        if free_share() >= 0.9 * share:
            return None
        pause(_PAUSE_S)
    free = free_share()
    return None if free >= 0.9 * share else free


def local_gpus() -> int:
    """Number of this machine's GPUs that CUDA can use."""
    import torch

    return torch.cuda.device_count()
