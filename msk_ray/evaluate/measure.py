"""Evaluation of a policy under one physics, with the spread of the results over episodes."""

import datetime
import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from msk_ray.config import Config, PhysicsConfig, RandomizeConfig, overlay, parse_config
from msk_ray.envs import env_class
from msk_ray.envs.randomize import Randomizer
from msk_ray.errors import ConfigError
from msk_ray.evaluate.targets import OWN, REFERENCE
from msk_ray.experiment.provenance import installed_versions
from msk_ray.progress import Pace
from msk_ray.training import Evaluator, SavedPolicy
from msk_ray.training.evaluation_tally import Episodes
from msk_ray.training.machine import device_name
from msk_ray.training.named_out_of_memory import named_out_of_memory
from msk_ray.training.threads import use_threads

DISTURBED = "disturbed"
"""The condition under which a trial trains: its own `physics.randomize`."""
_PACKAGES = ("msk-ray", "torch", "warp-lang", "mujoco", "mujoco-warp")


@dataclass(frozen=True)
class Request:
    """How to evaluate a policy. None: as in its trial's own evaluation."""

    physics: str = REFERENCE
    """`reference`, `own` (what the trial trains on), or a named physics of the environment."""
    worlds: int | None = None
    seeds: tuple[int, ...] | None = None
    steps: int | None = None
    varied: RandomizeConfig | None = None
    """Parameters of the model to change."""
    condition: str | None = None
    """One of the environment's `conditions`, which make the task harder, or `DISTURBED`."""


def under_condition(config: Config, name: str) -> tuple[Config, RandomizeConfig | None]:
    """A config changed to a harder condition of its environment, and the random parameters under that condition.

    Raises:
        ConfigError: the environment has no such condition.
    """
    known, drawn = config.env.conditions, config.physics.randomize
    if name == DISTURBED and drawn is not None:
        return config, drawn
    if name not in known:
        names = [*known, *([DISTURBED] if drawn is not None else [])]
        instead = f"has {', '.join(names)}; write one of these, or leave it out" if names else "has none; leave it out"
        raise ConfigError(f"--with {name}: a trial of env {config.env.name} {instead}")
    values = {key: value for key, value in known[name].items() if key != "physics.randomize"}
    harder = parse_config(overlay(config.as_dict(), values)) if values else config
    varied = known[name].get("physics.randomize")
    return harder, None if varied is None else RandomizeConfig.model_validate(varied)


def named_physics(config: Config, name: str) -> tuple[str, PhysicsConfig]:
    """The physics that `--physics NAME` means for a trial: the name to print, and the settings.

    Raises:
        ConfigError: the environment has no physics of that name.
    """
    env_type = env_class(config.env)
    variants = config.env.variants
    trained_on = config.physics.model_copy(update={"randomize": None})
    if name == REFERENCE:
        variant = config.evaluation.variant or (variants[0] if variants else OWN)
        return variant, env_type.reference_physics(trained_on, config.evaluation.variant)
    if name == OWN:
        return OWN, trained_on
    if name not in variants:
        known = ", ".join((REFERENCE, OWN, *variants))
        raise ConfigError(f"--physics {name!r}: env {config.env.name} has no such physics; write one of {known}")
    return name, env_type.reference_physics(trained_on, name)


_WORLDS = ("--worlds", "evaluation.nworld")


class Bench:
    """Evaluates policies on one device; trials with the same environment, physics and size share one simulation."""

    def __init__(self, device: str, tell: bool = False) -> None:
        """
        Args:
            device: "cpu" or "cuda:N".
            tell: whether to print progress.
        """
        self._device = device
        self._tell = tell
        self._evaluators: dict[str, Evaluator] = {}

    def evaluator(self, config: Config, request: Request) -> tuple[Evaluator, str]:
        """The evaluator for a request, and the name of its physics.

        Raises:
            ConfigError, DeviceError, UnsupportedModelError, SimulationError: as their messages say.
        """
        physics_name, physics = named_physics(config, request.physics)
        changes = {"nworld": request.worlds, "steps": request.steps}
        evaluation = config.evaluation.model_copy(update={k: v for k, v in changes.items() if v is not None})
        config = config.model_copy(update={"evaluation": evaluation})
        settings = env_class(config.env).reference_settings(config.env)
        sizes = (evaluation.nworld, evaluation.steps, evaluation.seed)
        key = repr((settings, physics, request.varied, sizes, config.execution))
        if key not in self._evaluators:
            with named_out_of_memory(self._device, evaluation.nworld, *_WORLDS):
                self._evaluators[key] = Evaluator(config, self._device, physics, request.varied)
        if request.varied is not None:
            physics_name = f"{physics_name}, {request.varied}"
        return self._evaluators[key], physics_name

    def check(self, config: Config, request: Request) -> None:
        """Raise ConfigError if a trial's environment lacks the requested physics or condition, or its model lacks the
        parameter to change. Runs nothing."""
        if request.condition is not None:
            under_condition(config, request.condition)
        _, physics = named_physics(config, request.physics)
        if request.varied is None:
            return
        model = env_class(config.env).build_model(config.env, physics)
        try:
            Randomizer(request.varied, model, torch.device("cpu"), 0)
        except ConfigError as error:
            raise ConfigError(f"--vary {str(error).removeprefix('physics.randomize.')}") from None

    def pace(self, total: int, unit: str = "env steps at most") -> Pace | None:
        """Prints progress towards a total; None if nothing should be printed."""
        return Pace(unit, total) if self._tell else None

    def evaluate(self, policy: SavedPolicy, request: Request) -> dict[str, Any]:
        """One entry of `eval.json`: what was evaluated, how, and the results.

        Raises:
            MskRayError: as for `evaluator`, or the checkpoint does not fit its environment.
        """
        use_threads(policy.config)
        config, conditioned = policy.config, request
        if request.condition is not None:
            config, varied = under_condition(config, request.condition)
            conditioned = replace(request, varied=varied)
        evaluator, physics = self.evaluator(config, conditioned)
        if request.condition is not None:
            physics = f"{physics.partition(',')[0]}, {request.condition}"
        trial_evaluation = policy.config.evaluation
        seeds = request.seeds or (trial_evaluation.seed,)
        with named_out_of_memory(self._device, evaluator.env.nworld, *_WORLDS):
            runs = [
                evaluator.episodes(policy.on(evaluator.env), seed, pace=self.pace(evaluator.steps)) for seed in seeds
            ]
        reference = named_physics(policy.config, REFERENCE)[1]
        canonical = (
            request.varied is None
            and request.condition is None
            and evaluator.env.nworld == trial_evaluation.nworld
            and seeds == (trial_evaluation.seed,)
            and request.steps in (None, trial_evaluation.steps or policy.config.env.episode_length)
            and named_physics(policy.config, request.physics)[1] == reference
        )
        setup = EvaluationSetup(
            physics, canonical, evaluator.env.nworld, seeds, evaluator.steps, device_name(self._device)
        )
        return entry_of(policy, setup, runs, evaluator.env.reward_names)


class EvaluationSetup(NamedTuple):
    """How an evaluation was done; the fields are named as in `eval.json`."""

    physics: str
    canonical: bool
    """Whether its score is comparable with `eval/score`."""
    worlds: int
    seeds: Sequence[int]
    steps: int
    device: str


def entry_of(
    policy: SavedPolicy, setup: EvaluationSetup, runs: Sequence[Episodes], reward_names: Sequence[str]
) -> dict[str, Any]:
    """One entry of `eval.json`: what was evaluated, how, and the results of one run for each seed."""
    how = setup._asdict()
    device = how.pop("device")
    return {
        "checkpoint": policy.path.name,
        "sha256": policy.sha256,
        "epoch": policy.epoch,
        "env_steps": policy.env_steps,
        **how,
        "seeds": list(setup.seeds),
        **figures(runs, reward_names),
        "scores": [round(float(s), 6) for run in runs for s in run.score],
        "score_by_seed": {str(seed): float(run.score.mean()) for seed, run in zip(setup.seeds, runs, strict=True)},
        "device": device,
        "packages": installed_versions(_PACKAGES),
        "python": platform.python_version(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def figures(runs: Sequence[Episodes], reward_names: Sequence[str]) -> dict[str, Any]:
    """Results over the episodes of all runs.

    Returns:
        `score`, `length`, `outcomes` and `terms`, each {mean, std, min, max} over episodes (std with n − 1; 0 for a
        single episode), and the shares `fall_rate`, `diverged_rate` and, where defined, `success_rate`. The mean of an
        outcome term is over env steps, its spread over the means of the episodes.
    """
    score, length, terms = (torch.cat([getattr(run, name) for run in runs]) for name in ("score", "length", "terms"))
    sums = {name: torch.cat([run.outcomes[name] for run in runs]) for name in runs[0].outcomes}
    outcomes = {
        name: spread(total / length) | {"mean": float(total.sum() / length.sum())} for name, total in sums.items()
    }
    result: dict[str, Any] = {
        "score": spread(score),
        "length": spread(length),
        "outcomes": outcomes,
        "terms": {name: spread(terms[:, column]) for column, name in enumerate(reward_names)},
        "fall_rate": float(torch.cat([run.fell for run in runs]).float().mean()),
        "diverged_rate": float(torch.cat([run.diverged for run in runs]).float().mean()),
    }
    successes = [run.success for run in runs if run.success is not None]
    if len(successes) == len(runs):
        result["success_rate"] = float(torch.cat(successes).float().mean())
    return result


def spread(values: Tensor) -> dict[str, float]:
    """Mean, standard deviation, minimum and maximum of values (E,)."""
    return {
        "mean": float(values.mean()),
        "std": float(values.std()) if len(values) > 1 else 0.0,
        "min": float(values.min()),
        "max": float(values.max()),
    }


def default_device() -> str:
    """The first GPU, or the CPU if there is none."""
    return "cuda:0" if torch.cuda.is_available() else "cpu"
