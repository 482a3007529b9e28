"""Let a policy walk and measure how."""

from dataclasses import replace
from typing import Any, NamedTuple

from msk_ray.envs import Env
from msk_ray.envs.legs.config import LegSettings
from msk_ray.envs.legs.gait.body import Array, Episode, Series, analyse, at_substeps, check_legs
from msk_ray.envs.legs.gait.measure import measure
from msk_ray.errors import ConfigError
from msk_ray.evaluate.measure import Bench, Made, Request, device_name, entry_of
from msk_ray.training import SavedPolicy
from msk_ray.visualize.episodes import record

_KEPT = ("gait_distance", "gait_distance_parts", "people", "at_speed", "measures", "timing", "costs", "strides")
"""Parts of a gait that `eval.json` has; curves are in `gait.json`."""


class Walk(NamedTuple):
    """A policy's gait, and the episodes that it was measured in."""

    gait: dict[str, Any]
    """Result of `measure`."""
    entry: dict[str, Any]
    """An entry of `eval.json`, with the gait's figures under `gait`."""
    episodes: list[Episode]
    qpos: list[Array]
    """Positions of each episode, (T, nq), at the times of its series."""
    env: Env[Any]


def at_target_speed(policy: SavedPolicy, speed: float) -> SavedPolicy:
    """The policy, told another target speed [m/s].

    Raises:
        ConfigError: its environment has no such setting.
    """
    env = policy.config.env
    if not isinstance(env, LegSettings):
        raise ConfigError(f"--speeds: env {env.name} is told no speed; leave it out")
    told = env.model_copy(update={"target_speed": speed})
    return replace(policy, config=policy.config.model_copy(update={"env": told}))


def walk(bench: Bench, policy: SavedPolicy, request: Request) -> Walk:
    """Run episodes and measure the gait in them, at every physics step.

    An env step is 2 % of a gait cycle long: a foot strike that is only seen at its end comes half of that too late.

    Raises:
        ConfigError: the model has no legs with the names that the leg environments use.
        MskRayError: as for `record`.
    """
    evaluator = bench.evaluator(policy.config, request)[0]
    env = evaluator.env
    check_legs(env.model)
    recording = record(bench, policy, request)
    model, episodes, positions = recording.model, [], []
    for world in range(recording.count):
        states = recording.world(world)
        recorded = Series(states.qpos, states.qvel, states.act)
        series = at_substeps(model, recorded, states.ctrl[:-1], round(recording.timestep / model.opt.timestep))
        positions.append(series.qpos)
        episodes.append(analyse(model, *series, model.opt.timestep))
    gait = measure(episodes, recording.episodes.fell.tolist())
    seeds = request.seeds or (policy.config.evaluation.seed,)
    made = Made(
        recording.physics, False, recording.count, seeds[:1], evaluator.steps, device_name(str(evaluator.env.device))
    )
    entry = entry_of(policy, made, [recording.episodes], evaluator.env.reward_names)
    return Walk(gait, entry | {"gait": {name: gait[name] for name in _KEPT}}, episodes, positions, env)
