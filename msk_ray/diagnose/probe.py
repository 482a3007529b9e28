"""The policy gradient of an environment's reward over several horizons, compared with float64 differences.

The gradient is of the undiscounted return over H env steps of the deterministic policy, without resets and without the
critic's bootstrap. The reference is C MuJoCo in float64 with the same policy and reward: central differences along
random directions in parameter space, because a policy has too many parameters for one difference each.
"""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from msk_ray.algorithms import algorithm_class
from msk_ray.config import Config, PhysicsConfig, load_config
from msk_ray.diagnose.exact import ExactGround, ExactKinematics, ExactTendons
from msk_ray.envs import Env, EnvState, make_env
from msk_ray.envs.measurements import Measurements
from msk_ray.errors import ConfigError, SimulationError
from msk_ray.step import StepState
from msk_ray.step.check import Oracle, Point
from msk_ray.training import SavedPolicy, load_policy

STATE_KINDS = ("reset", "standing", "gait")
"""Where trajectories start: a new reset; settled under zero action; in the policy's own motion."""

_SETTLE, _STRIDE = 60, 120
"""Env steps before a standing state and before a gait state."""
_STEP = 1e-6
"""Length of a displacement in parameter space; rounding of float64 leaves six digits."""

Step = Callable[[Tensor, StepState], StepState]


@dataclass(frozen=True)
class Subject:
    """The subject of a diagnosis: a trial's settings and a policy, trained or new."""

    config: Config
    saved: SavedPolicy | None
    """The trained policy; None for a new one."""

    def network(self, env: Env[Any]) -> nn.Module:
        """The policy's network for an environment, on its device.

        Raises:
            CheckpointError: it was trained on other observations or actions.
        """
        if self.saved is not None:
            return self.saved.network(env)
        # Some algorithms draw weights from the global generator.
        torch.manual_seed(self.config.trial.seed)
        algorithm = algorithm_class(self.config)
        return algorithm.policy_network(self.config, env.obs_size, env.action_size).to(env.device)


def read_subject(path: Path, overrides: Sequence[str] = ()) -> Subject:
    """A checkpoint (.pt) or a trial's config (.yaml).

    Raises:
        CheckpointError, ConfigError: it cannot be read, or overrides are given for a checkpoint.
    """
    if path.suffix == ".pt":
        if overrides:
            raise ConfigError("--set works with a config only; a checkpoint has its own settings")
        saved = load_policy(path)
        return Subject(saved.config, saved)
    return Subject(load_config(path, overrides), None)


@dataclass(frozen=True)
class Quality:
    """One world's policy gradient over one horizon."""

    variant: str
    state: str
    horizon: int
    world: int
    cosine: float
    """Cosine between backpropagated derivatives along the directions and those by differences."""
    norm_ratio: float
    """Norm of the backpropagated derivatives divided by the norm of the differences."""
    norm: float
    """Norm of the backpropagated gradient to all parameters [reward]."""
    cotangent: float
    """Norm of the gradient to the starting state [reward]."""


def probe(
    subject: Subject,
    variants: Sequence[str | None],
    states: Sequence[str],
    horizons: Sequence[int],
    *,
    worlds: int,
    directions: int,
    seed: int,
    device: str,
) -> Iterator[Quality]:
    """Compare gradients, variant by variant and state by state.

    Args:
        subject: policy and settings.
        variants: named physics of the environment; None for the subject's own.
        states: of `STATE_KINDS`; "gait" needs a trained policy.
        horizons: env steps H.
        worlds: starting states of each kind.
        directions: random directions in parameter space.
        seed: seed of starting states and directions.
        device: where Warp runs.

    Raises:
        ConfigError: "gait" for a new policy.
        SimulationError: the policy falls everywhere before its gait state.
    """
    if "gait" in states and subject.saved is None:
        raise ConfigError("--states gait needs a trained policy: give a checkpoint instead of a config")
    for variant in variants:
        physics = subject.config.physics if variant is None else PhysicsConfig(variant=variant)
        env = make_env(subject.config.env, physics, worlds, device, seed, execution=subject.config.execution)
        # Disable forces that finite differences would include but the gradient does not.
        env.measurements.ignore_contact_forces = True
        network = subject.network(env)
        for state in states:
            start = _starting_state(env, network, state)
            yield from _compare(
                env, network, start, sorted(horizons), directions, seed, variant or "own physics", state
            )


@torch.no_grad()
def _starting_state(env: Env[Any], network: nn.Module, kind: str) -> EnvState:
    env.state = env.reset_state()
    for _ in range({"reset": 0, "standing": _SETTLE, "gait": _STRIDE}[kind]):
        action = network(env.observation()) if kind == "gait" else torch.zeros_like(env.state.action)
        # Worlds whose episode ends before are reset, so that all worlds count.
        env.step(action)
    if kind == "gait" and int(env.state.age.max()) < _STRIDE:
        raise SimulationError(f"the policy falls in every world within {_STRIDE} env steps: it has no gait to diagnose")
    return env.state.detach()


def _returns(env: Env[Any], network: nn.Module, step: Step, start: EnvState, horizons: Sequence[int]) -> list[Tensor]:
    """Return (W,) of the first H env steps for each horizon."""
    total = torch.zeros_like(start.action[:, 0])
    returns = []
    env.state = start
    for t in range(1, horizons[-1] + 1):
        action = network(env.observation())
        physics = step(env.control(action), env.state.physics)
        reached = env.reached(physics, action)
        total = total + env.reward_terms(physics, action, env.observation_of(reached)).sum(-1)
        env.state = env.carried(reached)
        if t in horizons:
            returns.append(total)
    env.state = start
    return returns


def _compare(
    env: Env[Any],
    network: nn.Module,
    start: EnvState,
    horizons: Sequence[int],
    count: int,
    seed: int,
    variant: str,
    state: str,
) -> Iterator[Quality]:
    parameters = _acting(network, network, env.observation())
    leaves = StepState(*(t.clone().requires_grad_(True) for t in start.physics))
    returns = _returns(env, network, lambda a, s: env.sim.step(a, *s), start._replace(physics=leaves), horizons)
    size = sum(p.numel() for p in parameters)
    directions = np.random.default_rng(seed).normal(size=(count, size))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = _differences(env, network, start, horizons, directions)
    for i, (horizon, per_world) in enumerate(zip(horizons, returns, strict=True)):
        for world in range(len(per_world)):
            gradients = torch.autograd.grad(
                per_world[world], [*parameters, *leaves], retain_graph=True, allow_unused=True
            )
            flat = torch.cat([g.flatten() for g in gradients[: len(parameters)] if g is not None])
            along = directions @ flat.double().cpu().numpy()
            other = expected[i, world]
            sizes = float(np.linalg.norm(along)), float(np.linalg.norm(other))
            to_state = torch.cat([g[world].flatten() for g in gradients[len(parameters) :] if g is not None])
            yield Quality(
                variant,
                state,
                horizon,
                world,
                float(along @ other) / (sizes[0] * sizes[1]),
                sizes[0] / sizes[1],
                float(flat.norm()),
                float(to_state.norm()),
            )


@torch.enable_grad()
def _acting(owner: nn.Module, network: nn.Module, obs: Tensor) -> list[nn.Parameter]:
    """Parameters of `owner`, a copy of `network`, that affect the deterministic action; log σ does not."""
    gradients = torch.autograd.grad(network(obs.detach()).sum(), list(network.parameters()), allow_unused=True)
    return [p for p, gradient in zip(owner.parameters(), gradients, strict=True) if gradient is not None]


@torch.no_grad()
def _differences(
    env: Env[Any], network: nn.Module, start: EnvState, horizons: Sequence[int], directions: np.ndarray
) -> np.ndarray:
    """Derivatives (H, W, K) of the return along directions (K, P), by C MuJoCo in float64."""
    exact = copy.deepcopy(network).double().cpu()
    ideal = _double(env)
    oracle = Oracle(env.model, env.sim.substeps)
    parameters = _acting(exact, network, env.observation())
    at = nn.utils.parameters_to_vector(parameters)

    def step(action: Tensor, state: StepState) -> StepState:
        ends = [
            oracle.step(Point(*(t[w].numpy() for t in (action, state.qpos, state.qvel, state.act))))
            for w in range(len(action))
        ]
        return StepState(*(torch.from_numpy(np.stack([getattr(e, n) for e in ends])) for n in StepState._fields))

    begin = start.mapped(_in_double)

    def displaced(direction: np.ndarray) -> Tensor:
        nn.utils.vector_to_parameters(at + _STEP * torch.from_numpy(direction), parameters)
        return torch.stack(_returns(ideal, exact, step, begin, horizons))

    slopes = [(displaced(d) - displaced(-d)) / (2.0 * _STEP) for d in directions]
    return torch.stack(slopes, dim=-1).numpy()


def _double(env: Env[Any]) -> Env[Any]:
    """A copy of the environment in float64 on the CPU, for observations and rewards, not for steps."""
    ideal = copy.copy(env)
    for name, value in vars(env).items():
        setattr(ideal, name, _in_double(value))
    ideal.device = torch.device("cpu")
    ideal.measurements = Measurements(
        env.sim, type(env).__qualname__, ExactKinematics(env.model), ExactTendons(env.model), ExactGround(env.model)
    )
    ideal.measurements.ignore_contact_forces = env.measurements.ignore_contact_forces
    return ideal


def _in_double(value: Any) -> Any:
    """Tensors, also in tuples, lists and dicts, as float64 on the CPU; anything else unchanged."""
    match value:
        case Tensor():
            return value.cpu().double() if value.is_floating_point() else value.cpu()
        case tuple() | list():
            parts = [_in_double(part) for part in value]
            return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
        case dict():
            return {key: _in_double(part) for key, part in value.items()}
    return value
