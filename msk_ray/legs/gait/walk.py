"""Let a policy walk and measure how."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from msk_ray.envs import Env
from msk_ray.errors import ConfigError
from msk_ray.evaluate.measure import Bench, EvaluationSetup, Request, device_name, entry_of
from msk_ray.legs.config import LegSettings
from msk_ray.legs.gait.body import Array, Episode, Motion, analyse, between, check_legs
from msk_ray.legs.gait.measure import measure
from msk_ray.training import SavedPolicy
from msk_ray.training.threads import use_threads
from msk_ray.visualize.recording import Recording, record

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
    """Positions of each episode at its samples, (T, nq)."""
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
    """Run episodes and measure the gait in them, at every physics substep (`body.between`).

    The figures of an evaluation during training are at control steps instead (`LegEnv.trajectory_figures`).

    Raises:
        ConfigError: the model has no legs with the names that the leg environments use.
        MskRayError: as for `record` and `between`.
    """
    use_threads(policy.config)
    evaluator = bench.evaluator(policy.config, request)[0]
    env = evaluator.env
    check_legs(env.model)
    recording = record(bench, policy, request)
    episodes, positions = [], []
    pace = bench.pace(recording.count, "episodes measured")
    for world in range(recording.count):
        motion = every_substep(recording, world, env.sim.substeps)
        positions.append(motion.qpos)
        episodes.append(analyse(recording.model, *motion, recording.model.opt.timestep))
        if pace is not None:
            pace(world + 1)
    gait = measure(episodes, recording.episodes.fell.tolist())
    seeds = request.seeds or (policy.config.evaluation.seed,)
    setup = EvaluationSetup(
        recording.physics, False, recording.count, seeds[:1], evaluator.steps, device_name(str(evaluator.env.device))
    )
    entry = entry_of(policy, setup, [recording.episodes], evaluator.env.reward_names)
    return Walk(gait, entry | {"gait": {name: gait[name] for name in _KEPT}}, episodes, positions, env)


def every_substep(recording: Recording, world: int, substeps: int) -> Motion:
    """The states of one episode at every physics substep.

    Args:
        recording: the episodes.
        world: which.
        substeps: physics steps per env step.

    Raises:
        SimulationError: as for `between`.
    """
    # A step that diverged has no result: the state that is recorded after it is the one before.
    count = recording.length(world) + 1 - int(recording.episodes.diverged[world])
    states = recording.world(world).at(np.arange(count))
    applied = None if recording.applied is None else recording.applied[:count, world].double().numpy()
    recorded = Motion(states.qpos, states.qvel, states.act)
    return between(recording.model, recorded, states.ctrl, substeps, applied)
