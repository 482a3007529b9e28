"""How well a policy follows each clip of a library, once and from its first frame.

After Appendix F of SuperMimic (arXiv:2610.28480), as far as it is known here: docs/robots/tracking.md.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from msk_ray.errors import ConfigError
from msk_ray.robots.tracking.config import MOTION_TERMS, G1TrackingSettings
from msk_ray.robots.tracking.env import G1Tracking
from msk_ray.training import Evaluator, SavedPolicy


@dataclass(frozen=True)
class ClipScore:
    """One clip, followed once."""

    clip: str
    seconds: float
    failed: bool
    """The pelvis was off by more than 0.25 m in height or 0.8 in tilt, or the physics diverged."""
    followed: float
    """Share of the clip until then."""
    normalised_return: float
    """Return, divided by the greatest one of the whole clip: 1 if every step is as the reference, without costs."""
    normalised_motion: float
    """The same without costs."""
    mpkpe: float
    """Mean distance of the tracked bodies from where the clip has them, while it was followed [m]."""
    r_mpkpe: float
    """That with the clip moved to the robot [m]."""


def follow_clips(
    policy: SavedPolicy,
    device: str,
    motion: str | None = None,
    pace: Callable[[int], Callable[[int], None]] | None = None,
) -> list[ClipScore]:
    """Scores of all clips, by one deterministic policy, without noise.

    Args:
        policy: the policy.
        device: "cpu" or "cuda:N".
        motion: clips to follow, as `env.motion`; None: those that it was trained on.
        pace: is given the largest number of steps, and gives what to call after each.

    Raises:
        ConfigError: the policy does not follow motions, or there are none.
    """
    env = policy.config.env
    if not isinstance(env, G1TrackingSettings):
        raise ConfigError(f"{policy.path}: env {env.name} follows no motions; write a policy of g1_tracking")
    changes: dict[str, Any] = {"score_sampling": "start", "score_failure": "pelvis"}
    settings = env.model_copy(update=changes | ({} if motion is None else {"motion": motion}))
    lengths = G1Tracking.library(settings).lengths
    evaluation = policy.config.evaluation.model_copy(update={"nworld": len(lengths), "steps": max(lengths)})
    config = policy.config.model_copy(update={"env": settings, "evaluation": evaluation})
    evaluator = Evaluator(config, device)
    assert isinstance(evaluator.env, G1Tracking)
    tell = None if pace is None else pace(evaluator.steps)
    episodes = evaluator.episodes(policy.on(evaluator.env), pace=tell).cpu()
    names, weights = evaluator.env.reward_names, type(env.reward)()
    motions = [names.index(name) for name in MOTION_TERMS]
    greatest = sum(float(getattr(weights, name)) for name in MOTION_TERMS)
    scores = []
    for world, (clip, length) in enumerate(zip(evaluator.env.references.names, lengths, strict=True)):
        steps = float(episodes.length[world])
        scores.append(
            ClipScore(
                clip,
                length * settings.control_timestep,
                bool(episodes.fell[world] | episodes.diverged[world]),
                steps / length,
                float(episodes.score[world]) / (greatest * length),
                float(episodes.terms[world, motions].sum()) / (greatest * length),
                *(float(episodes.outcomes[name][world]) / steps for name in ("mpkpe", "r_mpkpe")),
            )
        )
    return scores


def totals(scores: list[ClipScore]) -> dict[str, Any]:
    """Number of clips and of those that failed, and means over clips; `by_time` is the mean return over all frames."""
    seconds = sum(score.seconds for score in scores)
    figures = ("followed", "normalised_return", "normalised_motion", "mpkpe", "r_mpkpe")
    means = {name: sum(getattr(score, name) for score in scores) / len(scores) for name in figures}
    by_time = sum(score.normalised_return * score.seconds for score in scores) / seconds
    failed = sum(score.failed for score in scores)
    return {"clips": len(scores), "seconds": seconds, "failed": failed, **means, "by_time": by_time}


def as_json(scores: list[ClipScore], policy: SavedPolicy) -> dict[str, Any]:
    """What `clips.json` says."""
    env = policy.config.env
    assert isinstance(env, G1TrackingSettings)
    facts = {"checkpoint": policy.path.name, "epoch": policy.epoch, "env_steps": policy.env_steps}
    seen = {"layout": env.layout, "future_frames": list(env.future_frames)}
    return {**facts, **seen, "totals": totals(scores), "clips": [asdict(score) for score in scores]}
