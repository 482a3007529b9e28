"""Scores of a policy on each clip of a library, which it follows once from its first frame.

The protocol is Appendix F of SuperMimic (arXiv:2610.28480); docs/robots/tracking.md says which parts are guesses.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from msk_ray.config import Config
from msk_ray.errors import ConfigError
from msk_ray.robots.tracking.config import MOTION_TERMS, G1TrackingSettings
from msk_ray.robots.tracking.env import G1Tracking
from msk_ray.training import Evaluator, SavedPolicy


@dataclass(frozen=True)
class ClipScore:
    """How a policy followed one clip."""

    clip: str
    """Name of the clip."""
    seconds: float
    """Duration of the clip [s]."""
    failed: bool
    """Whether the pelvis was off by more than 0.25 m in height, or by 0.8 in the vertical component of gravity in its
    axes, or the physics diverged."""
    followed: float
    """Share of the clip before the failure; 1 without one."""
    normalised_return: float
    """Return divided by the largest possible one: 1 if every step matches the reference and costs nothing."""
    normalised_motion: float
    """The same from the motion terms alone, without costs."""
    mpkpe: float
    """Mean distance of the tracked bodies from the reference, over the part that was followed [m]."""
    r_mpkpe: float
    """The same after moving the reference to the robot's anchor and turning it to the robot's heading [m]."""


def follow_clips(
    policy: SavedPolicy,
    device: str,
    motion: str | None = None,
    pace: Callable[[int], Callable[[int], None]] | None = None,
) -> list[ClipScore]:
    """Let a policy follow each clip, deterministically, without noise and from the first frame.

    Args:
        policy: a policy of `g1_tracking`.
        device: "cpu" or "cuda:N".
        motion: clips to follow, as in `env.motion`; None: those that the policy was trained on. `env.cut` and
            `env.mirror` stay those of its training.
        pace: makes a progress display for a number of env steps; the display is called after each step with the number
            of steps done.

    Raises:
        ConfigError: the policy does not follow motions, or there are no clips.
    """
    evaluator = Evaluator(_evaluation_config(policy, motion), device)
    env = evaluator.env
    assert isinstance(env, G1Tracking)
    progress = None if pace is None else pace(evaluator.steps)
    episodes = evaluator.episodes(policy.on(env), pace=progress).cpu()
    weights = type(env.config.reward)()
    largest_reward = sum(float(getattr(weights, name)) for name in MOTION_TERMS)
    motion_columns = [env.reward_names.index(name) for name in MOTION_TERMS]
    scores = []
    for world, (clip, length) in enumerate(zip(env.references.names, env.references.lengths, strict=True)):
        steps = float(episodes.length[world])
        largest_return = largest_reward * length
        scores.append(
            ClipScore(
                clip=clip,
                seconds=length * env.config.control_timestep,
                failed=bool(episodes.fell[world] | episodes.diverged[world]),
                followed=steps / length,
                normalised_return=float(episodes.score[world]) / largest_return,
                normalised_motion=float(episodes.terms[world, motion_columns].sum()) / largest_return,
                mpkpe=float(episodes.outcomes["mpkpe"][world]) / steps,
                r_mpkpe=float(episodes.outcomes["r_mpkpe"][world]) / steps,
            )
        )
    return scores


def _evaluation_config(policy: SavedPolicy, motion: str | None) -> Config:
    """A policy's config with one world for each clip; worlds begin with the first frame and fail by the pelvis."""
    env = policy.config.env
    if not isinstance(env, G1TrackingSettings):
        raise ConfigError(f"{policy.path}: env {env.name} follows no motions; write a policy of g1_tracking")
    changes: dict[str, Any] = {"score_sampling": "start", "score_failure": "pelvis"}
    settings = env.model_copy(update=changes | ({} if motion is None else {"motion": motion}))
    lengths = G1Tracking.library(settings).lengths
    evaluation = policy.config.evaluation.model_copy(update={"nworld": len(lengths), "steps": max(lengths)})
    return policy.config.model_copy(update={"env": settings, "evaluation": evaluation})


def totals(scores: list[ClipScore]) -> dict[str, Any]:
    """Number, duration [s] and failures of all clips, and means of the other figures over clips.

    `normalised_return_by_frame` is the mean of `normalised_return` over frames instead of clips.
    """
    seconds = sum(score.seconds for score in scores)
    figures = ("followed", "normalised_return", "normalised_motion", "mpkpe", "r_mpkpe")
    means = {name: sum(getattr(score, name) for score in scores) / len(scores) for name in figures}
    by_frame = sum(score.normalised_return * score.seconds for score in scores) / seconds
    failed = sum(score.failed for score in scores)
    every = {"clips": len(scores), "seconds": seconds, "failed": failed}
    return every | means | {"normalised_return_by_frame": by_frame}


def as_json(scores: list[ClipScore], policy: SavedPolicy, motion: str | None) -> dict[str, Any]:
    """The content of `clips.json`. `motion` is as for `follow_clips`."""
    env = policy.config.env
    assert isinstance(env, G1TrackingSettings)
    origin = {"checkpoint": policy.path.name, "epoch": policy.epoch, "env_steps": policy.env_steps}
    clips = {"motion": motion or env.motion, "cut": env.cut, "mirror": env.mirror}
    observation = {"layout": env.layout, "future_frames": list(env.future_frames)}
    return {**origin, **clips, **observation, "totals": totals(scores), "clips": [asdict(score) for score in scores]}
