"""Learning curves of an experiment as one PNG: a line a variant, a band over its seeds."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

from msk_ray.tune.outcomes import Outcome
from msk_ray.tune.records import TrialRecord

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.ticker import EngFormatter

MAX_LABELS = 16
_STOPPED = {Outcome.STOPPED_ASHA, Outcome.STOPPED_MEDIAN, Outcome.STOPPED_PLATEAU, Outcome.NONFINITE, Outcome.DIVERGED}


def draw_curves(records: Sequence[TrialRecord], path: Path, title: str) -> None:
    """Draw score over env steps into `path`.

    The line is the mean over seeds, the band their range. A cross ends a trial that was stopped before its time. The
    axis reaches down to the worst untrained or best score; a policy that falls apart may leave it.
    """
    groups: dict[str, list[TrialRecord]] = {}
    for record in records:
        if record.evaluations:
            groups.setdefault(record.trial.variant, []).append(record)
    ranked = sorted(groups.items(), key=lambda item: -_mean_best(item[1]))
    figure, axes = plt.subplots(figsize=(9.0, 5.5), layout="constrained")
    colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.9, max(1, len(ranked))))
    for number, (variant, group) in enumerate(ranked):
        label = variant if number < MAX_LABELS else None
        _draw_variant(axes, group, colours[number], label)
    axes.set_title(title)
    axes.set_xlabel("env steps")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_ylabel("evaluation score")
    bottom = _lowest_of_interest(records)
    if bottom is not None and bottom > axes.get_ylim()[0]:
        axes.set_ylim(bottom=bottom)
    axes.grid(alpha=0.3)
    axes.margins(x=0.02)
    if ranked:
        hidden = len(ranked) - MAX_LABELS
        note = f"best first; {hidden} more not named" if hidden > 0 else "best first"
        axes.legend(fontsize=8, title=note, title_fontsize=8, loc="best", framealpha=0.9)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _draw_variant(axes: plt.Axes, group: list[TrialRecord], colour: np.ndarray, label: str | None) -> None:
    curves = [_curve(record) for record in group]
    steps = np.unique(np.concatenate([curve[0] for curve in curves]))
    # A curve ends where its trial did: beyond, it has no value, and the mean is over those that went on.
    values = np.array([np.interp(steps, x, y, right=np.nan) for x, y in curves])
    axes.plot(steps, np.nanmean(values, axis=0), color=colour, label=label, linewidth=1.8)
    if len(curves) > 1:
        axes.fill_between(
            steps, np.nanmin(values, axis=0), np.nanmax(values, axis=0), color=colour, alpha=0.15, linewidth=0
        )
    for record, (x, y) in zip(group, curves, strict=True):
        if record.ending is not None and record.ending.outcome in _STOPPED:
            axes.plot(x[-1], y[-1], marker="x", color=colour, markersize=8, markeredgewidth=2)


def _curve(record: TrialRecord) -> tuple[np.ndarray, np.ndarray]:
    """Env steps and scores, both (E,), of the evaluations with a finite score."""
    points = [(e.env_steps, e.score) for e in record.evaluations if np.isfinite(e.score)]
    array = np.array(points or [(0, np.nan)], dtype=float)
    return array[:, 0], array[:, 1]


def _lowest_of_interest(records: Sequence[TrialRecord]) -> float | None:
    """The lowest first or best score, with a margin of a tenth of their range; None if they do not differ."""
    ends = [_curve(record)[1] for record in records if record.best is not None]
    scores = [score for y in ends for score in (y[0], y.max())]
    span = max(scores) - min(scores) if scores else 0.0
    return min(scores) - 0.1 * span if span else None


def _mean_best(group: list[TrialRecord]) -> float:
    scores = [record.best.score for record in group if record.best is not None]
    return float(np.mean(scores)) if scores else float("-inf")
