"""Policy learning through differentiable MuJoCo Warp, swept with Ray Tune.

The public names for libraries and notebooks. Each is loaded on first use: importing `msk_ray` loads neither torch nor
Warp.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msk_ray.algorithms import Algorithm as Algorithm
    from msk_ray.algorithms import EpochResult as EpochResult
    from msk_ray.config import AlgorithmSettings as AlgorithmSettings
    from msk_ray.config import Command as Command
    from msk_ray.config import Config as Config
    from msk_ray.config import Cost as Cost
    from msk_ray.config import EnvSettings as EnvSettings
    from msk_ray.config import Reward as Reward
    from msk_ray.config import Term as Term
    from msk_ray.config import load_config as load_config
    from msk_ray.envs import Env as Env
    from msk_ray.envs import Memory as Memory
    from msk_ray.envs import MjcfEnv as MjcfEnv
    from msk_ray.envs import MjcfSettings as MjcfSettings
    from msk_ray.step import Backward as Backward
    from msk_ray.step import Capacity as Capacity
    from msk_ray.step import FdJacobian as FdJacobian
    from msk_ray.step import Hybrid as Hybrid
    from msk_ray.step import Simulation as Simulation
    from msk_ray.step import StepState as StepState
    from msk_ray.step import TapeAll as TapeAll
    from msk_ray.step import TapePerSubstep as TapePerSubstep
    from msk_ray.step import check_gradients as check_gradients
    from msk_ray.train import train as train
    from msk_ray.training.loggers import Logger as Logger
    from msk_ray.training.policy import load_policy as load_policy

__version__ = "0.3.0"

_NAMES = {
    "msk_ray.algorithms": ("Algorithm", "EpochResult"),
    "msk_ray.config": (
        "AlgorithmSettings",
        "Command",
        "Config",
        "Cost",
        "EnvSettings",
        "Reward",
        "Term",
        "load_config",
    ),
    "msk_ray.envs": ("Env", "Memory", "MjcfEnv", "MjcfSettings"),
    "msk_ray.step.autograd": (
        "Backward",
        "Capacity",
        "FdJacobian",
        "Hybrid",
        "Simulation",
        "StepState",
        "TapeAll",
        "TapePerSubstep",
    ),
    "msk_ray.step.check": ("check_gradients",),
    "msk_ray.train": ("train",),
    "msk_ray.training.loggers": ("Logger",),
    "msk_ray.training.policy": ("load_policy",),
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names}

__all__ = sorted([*_HOMES, "__version__"])


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'msk_ray' has no attribute {name!r}; it has {', '.join(sorted(_HOMES))}")
    home = import_module(_HOMES[name])
    # `train` is the callable module, not the function, so that `msk_ray.train.X` keeps working.
    attribute = home if _HOMES[name] == f"msk_ray.{name}" else getattr(home, name)
    globals()[name] = attribute
    return attribute


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
