"""Charts over training: learning curves, gradient health, and which trial stopped when."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from msk_ray.errors import ConfigError
from msk_ray.experiment.layout import SPACE_FILE
from msk_ray.experiment.outcomes import Outcome
from msk_ray.experiment.records import TrialRecord
from msk_ray.metrics import HEALTH, SCORE
from msk_ray.metrics import metric as describe
from msk_ray.report.charts import (
    BLUE,
    DASHES,
    GREY,
    PALETTE,
    POINTS,
    Axis,
    Bars,
    Chart,
    Floor,
    Line,
    Picture,
    Plot,
    Point,
    Row,
    Style,
    format_steps,
    plain,
    points_each,
    rounded,
    thin_evenly,
    thin_peaks,
)
from msk_ray.report.reading import Reading, scores_of
from msk_ray.sweep.budget import extreme_configs, longest_budget
from msk_ray.sweep.space import recorded_space
from msk_ray.text import printable

NAMED = 8
"""Number of variants that are drawn in their own colour."""
CROWD = 60
"""From this number of variants, those without a colour of their own are fainter."""
_STOPPED = {
    Outcome.STOPPED_ASHA,
    Outcome.STOPPED_MEDIAN,
    Outcome.STOPPED_PLATEAU,
    Outcome.NONFINITE,
    Outcome.DIVERGED,
}
_GREEN, _ORANGE, _SKY, _RED = "#009E73", "#E69F00", "#56B4E9", "#D55E00"
_COLOURS = {
    "finished": _GREEN,
    "stopped_target": _GREEN,
    "stopped_asha": _ORANGE,
    "stopped_median": _ORANGE,
    "stopped_plateau": _SKY,
    "wall_time": _SKY,
    "nonfinite": _RED,
    "diverged": _RED,
    "out_of_memory": _RED,
    "error": _RED,
    "running": "#0072B2",
}
"""Of how a trial ended; grey for others."""
STEPS = Axis("env steps", "count", low=0.0)
_OVER = {
    "env_steps": (STEPS, ""),
    "seconds": (
        Axis("seconds of training", low=0.0),
        " Times compare where trials ran on equal devices, each alone on its own.",
    ),
}
"""Column of the metrics → the axis, and what to know about it."""

Curve = tuple[np.ndarray, np.ndarray]
Places = Mapping[Path, int]
"""Folder of a trial → its position in the page's list of trials."""


def learning_curves(
    groups: Mapping[str, Sequence[TrialRecord]],
    baseline: str | None,
    name: str,
    places: Places,
    *,
    over: str = "env_steps",
) -> Picture | None:
    """Score over training, a line a variant and a band over its seeds; None if no trained policy has a score.

    Args:
        groups: trials by variant.
        baseline: the variant that is drawn whatever its rank.
        name: the picture's.
        places: trials' positions in the page's list.
        over: the x axis, `env_steps` or `seconds`.
    """
    means = {v: float(np.mean(scores)) for v, trials in groups.items() if (scores := scores_of(trials))}
    curves = {v: [curve for t in groups[v] if len((curve := curve_over(t, over))[0])] for v in means}
    until = {v: _first_end(groups[v], over) for v in means}
    axis, more = _OVER[over]
    ranked = sorted(curves, key=lambda v: -means[v])
    if not ranked:
        return None
    named = ranked[:NAMED] + ([baseline] if baseline in ranked[NAMED:] else [])
    rest = len(ranked) - len(named)
    styles = [
        Style(PALETTE[n % len(PALETTE)], printable(variant), DASHES[n // len(PALETTE)], 2.0, marker="x")
        for n, variant in enumerate(named)
    ]
    if rest:
        styles.append(Style(GREY, f"{rest} more", width=0.8, opacity=0.6 if len(ranked) < CROWD else 0.35))
    count = points_each(sum(len(own) for own in curves.values()))
    lines: list[Line] = []
    crosses: list[Point] = []
    for variant in [v for v in reversed(ranked) if v not in named] + [v for v in reversed(ranked) if v in named]:
        style = named.index(variant) if variant in named else len(named)
        # A single seed is its own mean.
        averaged = variant in named and len(curves[variant]) > 1
        if averaged:
            x, mean, low, high = map(plain, _mean_and_range(curves[variant], until[variant]))
            text = f"{printable(variant)}\nmean of {len(curves[variant])} seeds"
            lines.append(Line(style, x, mean, text=text, low=low, high=high, when="unfiltered"))
        for trial in groups[variant]:
            curve = curve_over(trial, over)
            if not len(curve[0]):
                continue
            x, y = map(plain, thin_evenly(*curve, count))
            place = places[trial.folder]
            lines.append(Line(style, x, y, place, when="filtered" if averaged else "always"))
            if variant in named and trial.ending is not None and trial.ending.outcome in _STOPPED:
                crosses.append(Point(style, rounded(curve[0][-1]), rounded(curve[1][-1]), place, "ended here"))
    floor = _floor([curve for own in curves.values() for curve in own])
    plot = Plot(axis, Axis("evaluation score", floor=floor), tuple(lines), tuple(crosses))
    seeds = max(len(own) for own in curves.values())
    best = means[ranked[0]]
    return Picture(
        name,
        f"Evaluation score over {axis.name} of {len(ranked)} variants; the best is {ranked[0]} with a mean best score "
        f"of {best:.5g}.",
        ("The best variant is named first. " if len(ranked) > 1 else "")
        + ("Mean over seeds up to the end of the first that ran to its end, band: their range. " if seeds > 1 else "")
        + "A cross ends a trial that was stopped before its time; from there the mean is over those that went on."
        + more
        + _randomized([groups[variant] for variant in ranked]),
        Chart(tuple(styles), (plot,), zoom=True),
    )


def _randomized(groups: Sequence[Sequence[TrialRecord]]) -> str:
    """What is drawn in training and not in evaluation, as a sentence; empty if nothing is."""
    sections = [trials[0].trial.config.physics.randomize for trials in groups]
    drawn = [section for section in sections if section is not None]
    if not drawn:
        return ""
    some = f"{len(drawn)} of {len(sections)} variants are" if len(drawn) < len(sections) else "All variants are"
    kinds = "; or ".join(dict.fromkeys(map(str, drawn)))
    return f" {some} trained with {kinds}, drawn for every episode; every score is of the model as it is."


def _first_end(trials: Sequence[TrialRecord], over: str) -> float:
    """Where the first of some trials that ran to their end has its last score; infinite if none did.

    Trials take different times, and with adaptive horizons different env steps: beyond this point, a mean of those that
    are left would jump.
    """
    ended = (t for t in trials if t.ending is not None and t.ending.outcome in (Outcome.FINISHED, Outcome.WALL_TIME))
    return min((float(x[-1]) for t in ended if len(x := curve_over(t, over)[0])), default=math.inf)


def _mean_and_range(curves: Sequence[Curve], until: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Steps up to `until`, mean, minimum and maximum, each (N,), of curves that may end at different steps."""
    steps = np.unique(np.concatenate([x for x, _ in curves]))
    steps = steps[steps <= until]
    if len(steps) > POINTS:
        ends = [x[-1] for x, _ in curves if x[-1] <= until]
        steps = np.unique(np.append(np.linspace(steps[0], steps[-1], POINTS), ends))
    # A curve ends where its trial did: beyond, it has no value, and the mean is over those that went on.
    values = np.array([np.interp(steps, x, y, left=np.nan, right=np.nan) for x, y in curves])
    keep = ~np.isnan(values).all(0)
    steps, values = steps[keep], values[:, keep]
    return steps, np.nanmean(values, 0), np.nanmin(values, 0), np.nanmax(values, 0)


def _floor(curves: Sequence[Curve]) -> Floor | None:
    """The axis reaches down to the worst first or best score: policies that fall apart leave it. None if none does,
    or if an axis half as long again shows all.
    """
    scores = [score for _, y in curves for score in (y[0], y.max())]
    span = max(scores) - min(scores)
    bottom = min(scores) - 0.1 * span
    lowest = [float(y.min()) for _, y in curves]
    if span == 0.0 or min(lowest) >= min(scores) - 0.5 * span:
        return None
    left = sum(low < bottom for low in lowest)
    trials = "1 trial goes" if left == 1 else f"{left} trials go"
    return Floor(float(f"{bottom:.3g}"), f"▼ {trials} below this axis, down to {min(lowest):.4g}")


def gradient_health(reading: Reading, name: str, places: Places) -> Picture | None:
    """Norms, clipping and failures of gradients over training; None if no trial recorded any."""
    recorded = [m.name for m in HEALTH if any(_health_curve(t, m.name) for t in reading.trials)]
    if not recorded:
        return None
    # What stayed zero throughout is said in words.
    zero = [
        metric
        for metric in recorded
        if not any(np.nanmax(c[1]) for t in reading.trials if (c := _health_curve(t, metric)))
    ]
    present = [metric for metric in recorded if metric not in zero] or recorded[:1]
    zero = [metric for metric in zero if metric not in present]
    opacity = max(0.25, min(0.8, 12 / max(1, len(reading.trials))))
    styles = (
        Style(GREY, "a trial", width=0.9, opacity=opacity),
        Style("#D55E00", "a trial that failed", "--", 1.1),
        Style(BLUE, "the best trial", width=1.8),
    )
    count = points_each(len(present) * len(reading.trials))
    return Picture(
        name,
        f"{len(present)} measures of gradients and physics over env steps, a line a trial: "
        f"{', '.join(describe(m).meaning for m in present)}.",
        (f"Zero throughout: {', '.join(describe(m).meaning for m in zero)}. " if zero else "")
        + "Of many points the largest of each stretch is drawn: peaks are not lost. A cotangent is in units of reward: "
        "1 is what one reward would send back.",
        Chart(
            styles if reading.best is not None else styles[:2],
            tuple(_health_plot(reading, metric, count, places) for metric in present),
            zoom=True,
        ),
    )


def _health_plot(reading: Reading, metric: str, count: int, places: Places) -> Plot:
    """A metric of all trials: those that failed above the others, the best one above all."""
    lines = []
    logarithmic = False
    for trial in reading.trials:
        curve = _health_curve(trial, metric)
        if curve is not None:
            x, y = thin_peaks(*curve, count)
            logarithmic |= describe(metric).logarithmic and bool((y > 0.0).any())
            style = 2 if trial is reading.best else 1 if trial.failed else 0
            lines.append((style, x, y, places[trial.folder]))
    return Plot(
        STEPS,
        Axis(scale="log" if logarithmic else "linear"),
        tuple(
            # A logarithm has no place for zeros.
            Line(style, plain(x), plain(np.where(y > 0.0, y, np.nan) if logarithmic else y), place)
            for style, x, y, place in sorted(lines, key=lambda line: line[0])
        ),
        title=describe(metric).meaning,
    )


def curve_over(trial: TrialRecord, column: str) -> Curve:
    """A column of the metrics, such as `env_steps`, and the score, both (N,), of all evaluations with a finite score;
    the first is that of the untrained policy."""
    return _curve([row for row in trial.scored if math.isfinite(row.get(column, math.nan))], column, SCORE)


def _health_curve(trial: TrialRecord, metric: str) -> Curve | None:
    rows = [row for row in trial.rows if math.isfinite(row.get(metric, math.nan))]
    return _curve(rows, "env_steps", metric) if rows else None


def _curve(rows: Sequence[Mapping[str, float]], x: str, y: str) -> Curve:
    return np.array([row.get(x, math.nan) for row in rows]), np.array([row[y] for row in rows])


def stopping_map(reading: Reading, name: str, places: Places) -> Picture | None:
    """A bar a trial, as long as it ran, in the colour of how it ended; None if none has begun."""
    begun = [trial for trial in reading.trials if trial.epochs_done]
    if not begun:
        return None
    ordered = sorted(begun, key=lambda t: (t.score is None, -(t.score or 0.0), t.trial.index))
    seeds = len(reading.seeds) > 1
    rungs, unknown = rung_steps(reading)
    counts: dict[str, int] = {}
    for trial in ordered:
        counts[trial.outcome] = counts.get(trial.outcome, 0) + 1
    outcomes = list(counts)
    rows = []
    for trial in ordered:
        end = trial.rows[-1].get("env_steps", math.nan)
        score = "" if trial.score is None else f", best score {trial.score:.5g}"
        label = trial.trial.variant + (f", seed {trial.trial.seed}" if seeds else "")
        text = f"ended at {format_steps(end)} env steps{score}"
        rows.append(Row(outcomes.index(trial.outcome), printable(label), end, "", places[trial.folder], text))
    return Picture(
        name,
        f"{len(ordered)} trials as bars of env steps, the best score on top: "
        + ", ".join(f"{n} {outcome}" for outcome, n in counts.items())
        + ".",
        f"The best score on top. {unknown}Why each one stopped is in the table of trials.",
        Chart(
            tuple(Style(_COLOURS.get(outcome, GREY), outcome) for outcome in outcomes),
            (Bars(STEPS, tuple(rows), tuple(rungs), "rung"),),
            zoom=True,
        ),
    )


def rung_steps(reading: Reading) -> tuple[list[float], str]:
    """Env steps at which all trials are compared, and why they are not known if they are not.

    None for other rules, or if trials are compared at something else.
    """
    if reading.space is None:
        return [], ""
    scheduler = reading.space.scheduler
    if scheduler.time_attr != "env_steps" or not scheduler.rungs(1.0):
        return [], ""
    configs = [trial.trial.config for trial in reading.trials]
    if reading.space.searches:
        # The rungs of a search come from what it may suggest, whatever it has suggested so far.
        try:
            configs = extreme_configs(recorded_space(reading.experiment.path / SPACE_FILE))
        except ConfigError as error:
            return [], f"Where the rungs of {scheduler.kind} lie is not known: {error}. "
    return list(scheduler.rungs(longest_budget(reading.space, configs))), ""
