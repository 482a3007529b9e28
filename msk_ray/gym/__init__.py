"""Environments with Gymnasium's interfaces, for other libraries' algorithms.

`BatchedEnv` steps all worlds at once in MuJoCo Warp, `SingleEnv` one world in C MuJoCo. Importing this package needs
gymnasium: pip install 'msk-ray[gym]'.
"""

from importlib.util import find_spec

from msk_ray.errors import ConfigError

if find_spec("gymnasium") is None:
    raise ConfigError("msk_ray.gym needs gymnasium: pip install 'msk-ray[gym]'")

from msk_ray.gym.batched import BatchedEnv
from msk_ray.gym.single import SingleEnv

__all__ = ["BatchedEnv", "SingleEnv"]
