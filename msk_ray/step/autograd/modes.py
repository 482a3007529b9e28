"""The backward modes by name: the one place where a name becomes an object."""

from collections.abc import Callable
from typing import Any

from msk_ray.step.errors import ConfigError

from msk_ray.config import PhysicsConfig
from msk_ray.step.autograd.backward import Backward
from msk_ray.step.autograd.fd_jacobian import FdJacobian
from msk_ray.step.autograd.hybrid import Hybrid
from msk_ray.step.autograd.tape import TapeAll, TapePerSubstep


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
        ConfigError: no such mode, or it does not take one of the options.
    """
    mode = BACKWARD_MODES.get(name)
    if mode is None:
        raise ConfigError(f"unknown backward mode {name!r}: write one of {', '.join(BACKWARD_MODES)}")
    try:
        return mode(**options)
    except TypeError as error:
        raise ConfigError(f"backward mode {name!r} does not take these options: {error}") from error


def configured_backward(physics: PhysicsConfig) -> Backward:
    """The backward mode of a physics section."""
    match physics.backward:
        case "fd_jacobian":
            return FdJacobian(**physics.fd.model_dump())
        case "hybrid":
            tape = TapePerSubstep(physics.substep_grad_clip, contact_reach=physics.contact_reach)
            return Hybrid(tape, FdJacobian(**physics.fd.model_dump()))
        case name:
            clip, reach = physics.substep_grad_clip, physics.contact_reach
            return make_backward(name, substep_grad_clip=clip, contact_reach=reach)
