"""`--smoke`: a short version of a space, to check in minutes that every part of it runs."""

from typing import Any

from msk_ray.config import Config
from msk_ray.experiment.trial import Trial
from msk_ray.sweep.rules.scheduler import NoScheduler
from msk_ray.sweep.space import Space
from msk_ray.sweep.trials import base_settings, make_trial

TRIALS = 8
"""The largest number of trials."""
EPOCHS = 3
WORLDS = 8
EVALUATION_WORLDS = 4
EVALUATION_STEPS = 32


def without_early_stopping(space: Space) -> Space:
    """The space without early stopping by scores, so that each trial runs to its end. pbt stays: it ends no trial."""
    file = space.file
    changes: dict[str, Any] = {"stop": file.stop.without_scores()}
    if file.scheduler.ends_trials:
        changes["scheduler"] = NoScheduler()
    return space.model_copy(update={"file": file.model_copy(update=changes)})


def shrink(space: Space, trials: list[Trial]) -> list[Trial]:
    """A few short trials, in which every value of every factor occurs at least once."""
    base = base_settings(space)
    short: dict[str, Trial] = {}
    chosen = cover(trials)[:TRIALS]
    # Variants that differ only in shortened settings become equal; keep one of them. A single trial would test neither
    # concurrency nor comparison, so add further ones until there are two.
    spare = [trial for trial in trials if trial not in chosen]
    for place, trial in enumerate([*chosen, *spare]):
        if place >= len(chosen) and len(short) >= 2:
            break
        values = {**trial.values, **shorten(trial.config)}
        small = make_trial(space, base, trial.changed, values, trial.seed, len(short))
        short.setdefault(small.id, small)
    return list(short.values())


def cover(trials: list[Trial]) -> list[Trial]:
    """A small set of trials, chosen greedily, with every level of every factor and only the first seed."""
    missing = {pair for trial in trials for pair in trial.changed.items()}
    pool = [trial for trial in trials if trial.seed == trials[0].seed]
    chosen: list[Trial] = []
    while missing:
        best = max(pool, key=lambda trial: len(missing & set(trial.changed.items())))
        gain = missing & set(best.changed.items())
        if not gain:
            break
        chosen.append(best)
        missing -= gain
    return sorted(chosen, key=lambda trial: trial.index)


def shorten(config: Config) -> dict[str, Any]:
    """Dotted settings with which a trial takes seconds: few epochs, worlds and steps, and short epochs."""
    steps = config.evaluation.steps or config.env.episode_length
    own = config.algorithm_settings.shortened(EPOCHS)
    return {
        "trial.epochs": min(config.trial.epochs, EPOCHS),
        "execution.checkpoint_interval": 1,
        "env.nworld": min(config.env.nworld, max(1, WORLDS // config.execution.gpus) * config.execution.gpus),
        **{f"{config.algorithm_section}.{key}": value for key, value in own.items()},
        "evaluation.interval": 1,
        "evaluation.nworld": min(config.evaluation.nworld, EVALUATION_WORLDS),
        "evaluation.steps": min(steps, EVALUATION_STEPS),
    }
