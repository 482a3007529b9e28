"""Environments: observation and reward as torch functions of (qpos, qvel, act), so that both stay in the graph."""

from typing import Any

from msk_ray.config import EnvConfig, FdConfig, PhysicsConfig
from msk_ray.envs.ant import Ant
from msk_ray.envs.base import Env, EnvState, Transition
from msk_ray.envs.cartpole import CartPole
from msk_ray.simulation import Backward, FdJacobian, Hybrid, TapeAll, TapePerSubstep

__all__ = ["Ant", "CartPole", "Env", "EnvState", "Transition", "env_class", "make_backward", "make_env"]


def _fd_jacobian(fd: FdConfig) -> Backward:
    return FdJacobian(eps_ctrl=fd.eps_ctrl, eps_qpos=fd.eps_qpos, eps_qvel=fd.eps_qvel, max_worlds=fd.max_worlds)


def make_backward(physics: PhysicsConfig) -> Backward:
    """The backward mode a physics section names."""
    match physics.backward:
        case "tape_per_substep":
            return TapePerSubstep(physics.substep_grad_clip)
        case "tape_all":
            return TapeAll(physics.substep_grad_clip)
        case "fd_jacobian":
            return _fd_jacobian(physics.fd)
        case "hybrid":
            return Hybrid(TapePerSubstep(physics.substep_grad_clip), _fd_jacobian(physics.fd))


_ENVS: dict[str, type[Env[Any]]] = {"cartpole": CartPole, "ant": Ant}


def env_class(config: EnvConfig) -> type[Env[Any]]:
    """The environment that settings of this type describe."""
    return _ENVS[config.name]


def make_env(
    config: EnvConfig, physics: PhysicsConfig, nworld: int, device: str, seed: int, *, differentiable: bool = True
) -> Env[Any]:
    """Build the environment of a config section.

    Raises:
        UnsupportedModelError: the model cannot be stepped, or not differentiated by `physics.backward`.
        DeviceError: no such device.
    """
    backward = make_backward(physics) if differentiable else None
    return env_class(config)(config, physics, nworld, device, seed, backward)
