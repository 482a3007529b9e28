"""The backward modes by name: the one place where a name from a configuration becomes an object."""

from typing import Any

from msk_ray.errors import ConfigError
from msk_ray.simulation.backward import Backward
from msk_ray.simulation.fd_jacobian import FdJacobian

BACKWARD_MODES: dict[str, type[Backward]] = {FdJacobian.name: FdJacobian}


def make_backward(name: str, **options: Any) -> Backward:
    """A backward mode by name; `options` are its constructor's arguments.

    Raises:
        ConfigError: no such mode, or it does not take one of the options.
    """
    mode = BACKWARD_MODES.get(name)
    if mode is None:
        raise ConfigError(f"unknown backward mode {name!r}: write one of {', '.join(BACKWARD_MODES)}")
    try:
        return mode(**options)
    except TypeError as error:
        raise ConfigError(f"backward mode {name!r} does not take these options: {error}") from error
