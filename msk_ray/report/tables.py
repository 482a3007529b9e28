"""The page's tables as plain data."""

import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from msk_ray.errors import ConfigError
from msk_ray.experiment.outcomes import Outcome
from msk_ray.experiment.records import TrialRecord
from msk_ray.experiment.snapshot import State
from msk_ray.report.reading import Reading, scores_of
from msk_ray.report.statistics import Interval, difference_interval, mean_interval

_PLAIN_FIGURES = ("score", "score_std", "length", "fall_rate", "diverged_rate", "best_score")
BASELINE = "baseline"

MEANINGS: dict[str, str] = {
    Outcome.NONFINITE: "a score, loss or gradient was NaN or infinite",
    Outcome.DIVERGED: "a step lost contacts or constraint rows, so its results were no state",
    Outcome.OUT_OF_MEMORY: "the device has less memory than the settings need",
    Outcome.ERROR: "an exception, or the process died too often",
    State.INTERRUPTED: "begun and not ended, and nothing is running it: --resume continues it",
    State.STALE: "silent for too long, although the sweep runs",
}


@dataclass(frozen=True)
class VariantRow:
    """One variant over its seeds."""

    variant: str
    scores: list[float]
    """Best score of each seed that was evaluated."""
    planned: int
    mean: float | None
    interval: Interval | None
    difference: float | None
    """Mean minus the baseline's mean, over the env steps of `compared_at`; None for the baseline itself, or without
    scores."""
    difference_interval: Interval | None
    compared_at: float | None
    """Env steps at which this variant and the baseline are compared; None if all their trials ran to their end."""
    is_baseline: bool
    figures: dict[str, float]
    """Other outcomes at the best evaluation, such as the speed, mean over seeds."""
    reduced: int = 0
    """How many of the scores come from trials with half their worlds."""
    cut: int = 0
    """How many come from trials that were stopped or interrupted early, but did not fail."""
    env_steps: float | None = None
    """Env steps at which the best scores were reached, mean over seeds."""
    seconds: float | None = None
    """Seconds of training after which they were reached, mean over seeds."""

    @property
    def std(self) -> float | None:
        """Standard deviation of the scores over seeds; None for fewer than two."""
        return statistics.stdev(self.scores) if len(self.scores) > 1 else None

    @property
    def worst(self) -> float | None:
        """Lowest score of a seed."""
        return min(self.scores, default=None)

    @property
    def verdict(self) -> str:
        if self.is_baseline:
            return "baseline"
        if self.mean is None:
            return "no score"
        if self.difference is None:
            return "not comparable"
        if self.difference_interval is None:
            return "one seed" if self.planned == 1 else "too few seeds"
        if not self.difference_interval.excludes(0.0):
            return "unclear"
        word = "better" if self.difference > 0 else "worse"
        return word if self.compared_at is None else f"{word} so far"


def baseline_of(reading: Reading, asked: str | None) -> str | None:
    """The variant that others are compared with: the one asked for, the one called baseline, or the first.

    Raises:
        ConfigError: no variant, or more than one, has this name.
    """
    variants = list(reading.variants)
    if asked is not None:
        matches = [v for v in variants if v == asked] or [v for v in variants if asked in v]
        if len(matches) != 1:
            known = "; ".join((matches or variants)[:8])
            raise ConfigError(
                f"--baseline {asked!r}: {'more than one' if matches else 'no'} variant of {reading.name} has this "
                f"name; write one of: {known}"
            )
        return matches[0]
    if BASELINE in variants:
        return BASELINE
    return variants[0] if variants else None


def outcome_figures(trials: Sequence[TrialRecord]) -> list[str]:
    """Names of the environment's own outcomes in evaluations, such as `vx` and `success_rate`."""
    names: dict[str, None] = {}
    for trial in trials:
        names.update(dict.fromkeys(name for row in trial.scored for name in row if name.startswith("eval/")))
    short = [name.removeprefix("eval/") for name in names]
    return [name for name in short if "/" not in name and name not in _PLAIN_FIGURES]


def compare_variants(reading: Reading, baseline: str | None) -> list[VariantRow]:
    """One row per variant, compared with the baseline if there is one, the highest mean first, those without a score
    last."""
    groups = reading.variants
    reference = groups[baseline] if baseline is not None else []
    names = outcome_figures(reading.trials)
    rows = []
    for variant, trials in groups.items():
        scores = scores_of(trials)
        mean = _mean(scores) if scores else None
        own = variant == baseline
        at, pair = (None, None) if own else _on_equal_terms(trials, reference)
        at_best = [trial.best_row for trial in trials]
        means = {name: _mean_of(at_best, f"eval/{name}") for name in names}
        rows.append(
            VariantRow(
                variant,
                scores,
                len(trials),
                mean,
                mean_interval(scores),
                _mean(pair[0]) - _mean(pair[1]) if pair else None,
                difference_interval(*pair) if pair else None,
                at if pair else None,
                own,
                {name: value for name, value in means.items() if value is not None},
                sum(trial.attempt.reduction is not None and trial.score is not None for trial in trials),
                sum(trial.cut and trial.score is not None for trial in trials),
                _mean_of(at_best, "env_steps"),
                _mean_of(at_best, "seconds"),
            )
        )
    return sorted(rows, key=lambda row: (row.mean is None, -(row.mean or 0.0)))


def _on_equal_terms(
    trials: Sequence[TrialRecord], reference: Sequence[TrialRecord]
) -> tuple[float | None, tuple[list[float], list[float]] | None]:
    """The env steps at which two groups are compared, and their best scores up to there.

    A stopped trial looks worse than it is beside a complete run. So if any trial did not run to its end, all are
    compared up to the latest evaluation that all have reached. Failed trials count with their best score; trials
    without an evaluation do not count.

    Returns:
        Env steps, None if all ran to their end; and the scores of both groups, None if one has none.
    """
    begun = [t for t in (*trials, *reference) if not t.cut or t.score is not None]
    counted = {id(t) for t in begun}
    limit = math.inf
    if any(t.cut for t in begun):
        going = [t for t in begun if t.score is not None and not t.failed]
        limit = min(_last_within(t, math.inf) for t in going if t.cut)
        # Trials may be evaluated at different env steps: this is the last step that all of them cover.
        limit = min(_last_within(t, limit) for t in going)

    def within(group: Sequence[TrialRecord]) -> list[float]:
        scores = [[e.score for e in trial.within(limit)] for trial in group if id(trial) in counted]
        return [max(own) for own in scores if own]

    pair = (within(trials), within(reference))
    return (limit if limit < math.inf else None), (pair if limit > 0.0 and all(pair) else None)


def _last_within(trial: TrialRecord, limit: float) -> float:
    """Env steps of the last evaluation within `limit` env steps; 0 if there is none."""
    return max((float(e.env_steps) for e in trial.within(limit)), default=0.0)


def _mean(scores: Sequence[float]) -> float:
    return sum(scores) / len(scores)


def _mean_of(rows: Sequence[Mapping[str, float]], name: str) -> float | None:
    """Mean of a metric over the rows that have it; None if none has."""
    values = [row[name] for row in rows if name in row]
    return _mean(values) if values else None


def by_variant_and_environment(parts: Sequence[Reading]) -> dict[str, list[VariantRow | None]]:
    """Each variant's row in each part of an experiment, in the experiment's order; None where it has no trial."""
    rows = [{row.variant: row for row in compare_variants(part, None)} for part in parts]
    names = dict.fromkeys(variant for part in parts for variant in part.variants)
    return {name: [by_variant.get(name) for by_variant in rows] for name in names}


def failures(reading: Reading) -> list[tuple[str, str, list[TrialRecord]]]:
    """(name, meaning, trials) of each kind of failure, the most frequent first; interrupted trials are included."""
    by_outcome: dict[str, list[TrialRecord]] = {}
    for trial in reading.trials:
        if trial.failed or trial.state in (State.INTERRUPTED, State.STALE):
            by_outcome.setdefault(trial.outcome, []).append(trial)
    ordered = sorted(by_outcome.items(), key=lambda item: -len(item[1]))
    return [(name, MEANINGS.get(name, ""), trials) for name, trials in ordered]


def outcome_counts(reading: Reading) -> dict[str, int]:
    """How many trials have each outcome or state; the most frequent first."""
    return dict(Counter(trial.outcome for trial in reading.trials).most_common())
