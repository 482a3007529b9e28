"""The backward modes by name."""

from collections.abc import Callable
from typing import Any

from msk_ray.step.autograd.backward import Backward
from msk_ray.step.autograd.fd_jacobian import FdJacobian
from msk_ray.step.autograd.hybrid import Hybrid
from msk_ray.step.autograd.tape import TapeAll, TapePerSubstep
from msk_ray.step.errors import ConfigError


def _hybrid() -> Hybrid:
    return Hybrid(TapePerSubstep(), FdJacobian())


BACKWARD_MODES: dict[str, Callable[..., Backward]] = {
    TapePerSubstep.name: TapePerSubstep,
    TapeAll.name: TapeAll,
    FdJacobian.name: FdJacobian,
    Hybrid.name: _hybrid,
}


def make_backward(name: str, **options: Any) -> Backward:
    """A backward mode by name; `options` are its constructor's arguments.

    Raises:
        ConfigError: unknown mode, or it does not take one of the options.
    """
    mode = BACKWARD_MODES.get(name)
    if mode is None:
        raise ConfigError(f"unknown backward mode {name!r}: write one of {', '.join(BACKWARD_MODES)}")
    try:
        return mode(**options)
    except TypeError as error:
        raise ConfigError(f"backward mode {name!r} does not take these options: {error}") from error
