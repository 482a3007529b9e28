"""The loggers that `execution.loggers` can name."""

from collections.abc import Mapping, Sequence

from msk_ray.config.packages import require
from msk_ray.errors import ConfigError
from msk_ray.registry import Registry

LOGGERS = Registry(
    "execution.loggers",
    "msk_ray.loggers",
    {
        "tensorboard": "msk_ray.training.loggers.tensorboard:TensorBoard",
        "wandb": "msk_ray.training.loggers.wandb:Wandb",
        "mlflow": "msk_ray.training.loggers.mlflow:MLflow",
    },
)
"""Classes of loggers."""
_PACKAGES: Mapping[str, Mapping[str, str]] = {
    "wandb": {"wandb": "msk-ray[wandb]"},
    "mlflow": {"mlflow": "msk-ray[mlflow]"},
}
"""Optional modules of loggers, and what to install for each."""


def logger_paths(names: Sequence[str]) -> list[str]:
    """The import paths of loggers.

    Raises:
        ConfigError: a name is unknown or given twice, or its package is not installed.
    """
    paths = [LOGGERS.path(name) for name in names]
    for name, path in zip(names, paths, strict=True):
        if paths.count(path) > 1:
            raise ConfigError(f"execution.loggers: {name} is given twice; write it once")
        require(_PACKAGES.get(name, {}), f"execution.loggers: {name}")
    return paths
