"""Pictures over training: learning curves, gradient health, and which trial stopped when."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import ScalarFormatter

from msk_ray.errors import ConfigError
from msk_ray.experiment.layout import SPACE_FILE
from msk_ray.experiment.outcomes import Outcome
from msk_ray.metrics import HEALTH
from msk_ray.metrics import metric as describe
from msk_ray.report.pictures import (
    DASHES,
    GREY,
    PALETTE,
    POINTS,
    Picture,
    plain,
    points_each,
    shorten,
    steps_axis,
    thin_evenly,
    thin_peaks,
)
from msk_ray.report.reading import Reading, TrialReading
from msk_ray.sweep.budget import extreme_configs, longest_budget
from msk_ray.sweep.space import recorded_space
from msk_ray.text import printable

NAMED = 8
"""Number of variants that are drawn in their own colour."""
LABELLED = 60
"""Maximum number of trials that are named at their bar."""
_STOPPED = {
    Outcome.STOPPED_ASHA,
    Outcome.STOPPED_MEDIAN,
    Outcome.STOPPED_PLATEAU,
    Outcome.NONFINITE,
    Outcome.DIVERGED,
}
_LOOK = {
    "finished": ("#009E73", "o"),
    "stopped_target": ("#009E73", "*"),
    "stopped_asha": ("#E69F00", "x"),
    "stopped_median": ("#E69F00", "+"),
    "stopped_plateau": ("#56B4E9", "s"),
    "wall_time": ("#56B4E9", "D"),
    "nonfinite": ("#D55E00", "X"),
    "diverged": ("#D55E00", "v"),
    "out_of_memory": ("#D55E00", "P"),
    "error": ("#D55E00", "^"),
    "running": ("#0072B2", ">"),
    "interrupted": (GREY, "|"),
    "stale": (GREY, "1"),
    "waiting": (GREY, "."),
    "unreadable": ("#000000", "1"),
}
_OVER = {
    "env_steps": ("Learning curves", "env steps", ""),
    "seconds": (
        "Learning curves over time",
        "seconds of training",
        " Times compare where trials ran on equal devices, each alone on its own.",
    ),
}
"""Column of the metrics → the picture's title, the axis' name, and what to know about it."""

Curve = tuple[np.ndarray, np.ndarray]
Places = Mapping[Path, int]
"""Folder of a trial → its position in the page's list of trials."""


def learning_curves(
    groups: Mapping[str, Sequence[TrialReading]],
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
    means = {v: float(np.mean(scores)) for v, trials in groups.items() if (scores := _best_scores(trials))}
    curves = {v: [t.curve_over(over) for t in groups[v] if len(t.curve[0])] for v in means}
    until = {v: _first_end(groups[v], over) for v in means}
    title, axis, more = _OVER[over]
    ranked = sorted(curves, key=lambda v: -means[v])
    if not ranked:
        return None
    named = ranked[:NAMED] + ([baseline] if baseline in ranked[NAMED:] else [])
    rest = [v for v in ranked if v not in named]
    floor = _floor([curve for own in curves.values() for curve in own])
    ended = {
        t.folder: t.curve_over(over)
        for variant in ranked
        for t in groups[variant]
        if t.ending is not None and t.ending.outcome in _STOPPED and len(t.curve[0])
    }

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for variant in rest:
            steps, mean, *_ = _mean_and_range(curves[variant], until[variant])
            axes.plot(steps, mean, color=GREY, linewidth=0.7, alpha=0.6, zorder=1)
        for number, variant in enumerate(named):
            _draw_variant(axes, _mean_and_range(curves[variant], until[variant]), number, shorten(variant, 44))
            for trial in groups[variant]:
                if trial.folder in ended:
                    x, y = ended[trial.folder]
                    axes.plot(x[-1], y[-1], "x", color=_colour(number), markersize=7, markeredgewidth=2)
        steps_axis(axes)
        if floor is not None:
            axes.set_ylim(bottom=floor.at)
            axes.text(0.01, 0.01, floor.text, transform=axes.transAxes, fontsize=8, color="#a03000")
        if over == "seconds":
            axes.xaxis.set_major_formatter(ScalarFormatter())  # "100m" would be read as minutes
        axes.set_xlabel(axis)
        axes.set_ylabel("evaluation score")
        axes.grid(alpha=0.3)
        handles, labels = axes.get_legend_handles_labels()
        if rest:
            handles.append(Line2D([], [], color=GREY, linewidth=0.7))
            labels.append(f"{len(rest)} more")
        figure.legend(handles, labels, fontsize=8, title="best first", title_fontsize=8, loc="outside right upper")

    def lines() -> dict[str, Any]:
        shown = [(v, t) for v in ranked for t in groups[v] if len(t.curve[0])]
        count = points_each(len(shown))
        return {
            "kind": "curves",
            "x": axis,
            "y": "evaluation score",
            "floor": None if floor is None else {"at": floor.at, "text": floor.text},
            "variants": [
                {
                    "name": printable(variant),
                    "colour": _colour(named.index(variant)) if variant in named else None,
                    "dash": DASHES[named.index(variant) // len(PALETTE)] if variant in named else "-",
                    "trials": [places[t.folder] for t in groups[variant] if len(t.curve[0])],
                    # A single seed is its own mean.
                    "mean": [plain(line) for line in _mean_and_range(curves[variant], until[variant])]
                    if variant in named and len(curves[variant]) > 1
                    else None,
                }
                for variant in ranked
            ],
            "lines": [
                [places[t.folder], *map(plain, thin_evenly(*t.curve_over(over), count)), t.folder in ended]
                for _, t in shown
            ],
        }

    seeds = max(len(own) for own in curves.values())
    best = means[ranked[0]]
    return Picture(
        name,
        title,
        f"Evaluation score over {axis} of {len(ranked)} variants; the best is {ranked[0]} with a mean best score of "
        f"{best:.5g}.",
        ("Mean over seeds up to the end of the first that ran to its end, band: their range. " if seeds > 1 else "")
        + "A cross ends a trial that was stopped before its time; from there the mean is over those that went on."
        + more
        + _randomized([groups[variant] for variant in ranked]),
        lines(),
        draw,
    )


def _randomized(groups: Sequence[Sequence[TrialReading]]) -> str:
    """What is drawn in training and not in evaluation, as a sentence; empty if nothing is."""
    sections = [trials[0].trial.config.physics.randomize for trials in groups]
    drawn = [section for section in sections if section is not None]
    if not drawn:
        return ""
    some = f"{len(drawn)} of {len(sections)} variants are" if len(drawn) < len(sections) else "All variants are"
    kinds = "; or ".join(dict.fromkeys(map(str, drawn)))
    return f" {some} trained with {kinds}, drawn for every episode; every score is of the model as it is."


def _draw_variant(
    axes: Axes, means: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], number: int, label: str
) -> None:
    steps, mean, low, high = means
    axes.plot(steps, mean, DASHES[number // len(PALETTE)], color=_colour(number), label=label, linewidth=1.9, zorder=3)
    if (low < high).any():
        axes.fill_between(steps, low, high, color=_colour(number), alpha=0.16, linewidth=0, zorder=2)


def _first_end(trials: Sequence[TrialReading], over: str) -> float:
    """Where the first of some trials that ran to their end has its last score; infinite if none did.

    Trials take different times, and with adaptive horizons different env steps: beyond this point, a mean of those that
    are left would jump.
    """
    ended = (t for t in trials if t.ending is not None and t.ending.outcome in (Outcome.FINISHED, Outcome.WALL_TIME))
    return min((float(t.curve_over(over)[0][-1]) for t in ended if len(t.curve[0])), default=math.inf)


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


@dataclass(frozen=True)
class Floor:
    """Where an axis of scores ends although curves go lower."""

    at: float
    text: str
    """How many do, and how far."""


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


def _best_scores(trials: Sequence[TrialReading]) -> list[float]:
    return [trial.score for trial in trials if trial.score is not None]


def _colour(number: int) -> str:
    return PALETTE[number % len(PALETTE)]


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
    best = reading.best

    def draw(figure: Figure) -> None:
        grid = figure.subplots(math.ceil(len(present) / 2), 2, squeeze=False).ravel()
        for axes in grid[len(present) :]:
            axes.set_axis_off()
        for axes, metric in zip(grid, present, strict=False):
            _draw_health(axes, reading, metric)
        handles = [
            Line2D([], [], color=GREY, label="a trial"),
            Line2D([], [], color="#D55E00", linestyle="--", label="a trial that failed"),
        ]
        if best is not None:
            handles.append(Line2D([], [], color="#0072B2", linewidth=2, label="the best trial"))
        figure.legend(handles=handles, loc="outside upper center", ncols=3, fontsize=8)

    def lines() -> dict[str, Any]:
        count = points_each(len(present) * len(reading.trials))
        return {
            "kind": "health",
            "best": None if best is None else places[best.folder],
            "failed": [places[t.folder] for t in reading.trials if t.failed],
            "metrics": [
                {
                    "title": describe(metric).meaning,
                    "log": describe(metric).logarithmic,
                    "lines": [
                        [places[t.folder], *map(plain, thin_peaks(*curve, count))]
                        for t in reading.trials
                        if (curve := _health_curve(t, metric)) is not None
                    ],
                }
                for metric in present
            ],
        }

    rows = math.ceil(len(present) / 2)
    return Picture(
        name,
        "Gradient health",
        f"{len(present)} measures of gradients and physics over env steps, a line a trial: "
        f"{', '.join(describe(m).meaning for m in present)}.",
        (f"Zero throughout: {', '.join(describe(m).meaning for m in zero)}. " if zero else "")
        + "Of many points the largest of each stretch is drawn: peaks are not lost. A cotangent is in units of reward: "
        "1 is what one reward would send back.",
        lines(),
        draw,
        (9.0, 1.0 + 2.3 * rows),
    )


def _health_curve(trial: TrialReading, metric: str) -> Curve | None:
    values = trial.columns.get(metric)
    if values is None or not np.isfinite(values).any():
        return None
    keep = np.isfinite(values)
    return trial.columns["env_steps"][keep], values[keep]


def _draw_health(axes: Axes, reading: Reading, metric: str) -> None:
    title, logarithmic = describe(metric).meaning, describe(metric).logarithmic
    best = reading.best
    lines: dict[bool, list[np.ndarray]] = {False: [], True: []}
    largest = 0.0
    for trial in reading.trials:
        curve = _health_curve(trial, metric)
        if curve is None:
            continue
        x, y = thin_peaks(*curve)
        largest = max(largest, float(y.max()))
        if trial is best:
            axes.plot(x, y, color="#0072B2", linewidth=1.6, zorder=4)
        else:
            lines[trial.failed].append(np.column_stack((x, y)))
    alpha = max(0.25, min(0.8, 12 / max(1, len(reading.trials))))
    axes.add_collection(LineCollection(lines[False], colors=GREY, linewidths=0.8, alpha=alpha, zorder=2))
    axes.add_collection(LineCollection(lines[True], colors="#D55E00", linewidths=1.0, linestyles="--", zorder=3))
    axes.autoscale_view()
    if logarithmic and largest > 0.0:
        axes.set_yscale("log")
    elif largest == 0.0:
        axes.set_ylim(-0.05, 1.0)
    axes.set_title(title, fontsize=9)
    axes.tick_params(labelsize=8)
    steps_axis(axes)
    axes.grid(alpha=0.3)


def stopping_map(reading: Reading, name: str, places: Places) -> Picture | None:
    """A bar a trial, as long as it ran, its end marked by how it ended; None if none has begun."""
    begun = [trial for trial in reading.trials if trial.epochs_done]
    if not begun:
        return None
    ordered = sorted(begun, key=lambda t: (t.score is None, -(t.score or 0.0), t.trial.index))
    seeds = len(reading.seeds) > 1
    lines, unknown = rung_steps(reading)

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for place, trial in enumerate(ordered):
            colour, marker = _LOOK.get(trial.outcome, (GREY, "."))
            end = float(trial.columns["env_steps"][-1])
            axes.plot(
                [0.0, end], [place, place], color=colour, linewidth=1.2 if len(ordered) > LABELLED else 2.5, alpha=0.7
            )
            axes.plot(end, place, marker, color=colour, markersize=4 if len(ordered) > LABELLED else 7)
        for step in lines:
            axes.axvline(step, color="black", linestyle=":", linewidth=0.9)
        axes.set_ylim(len(ordered) - 0.4, -0.6)
        if len(ordered) <= LABELLED:
            labels = [t.trial.variant + (f", seed {t.trial.seed}" if seeds else "") for t in ordered]
            axes.set_yticks(range(len(ordered)), [shorten(label, 48) for label in labels], fontsize=7)
        else:
            axes.set_ylabel("trials, the best score first")
        steps_axis(axes)
        shown = list(dict.fromkeys(t.outcome for t in ordered))
        handles = [
            Line2D([], [], color=_LOOK.get(o, (GREY, "."))[0], marker=_LOOK.get(o, (GREY, "."))[1], label=o)
            for o in shown
        ]
        if lines:
            handles.append(Line2D([], [], color="black", linestyle=":", label="rung of asha"))
        figure.legend(handles=handles, loc="outside upper center", ncols=5, fontsize=8)

    counts: dict[str, int] = {}
    for trial in ordered:
        counts[trial.outcome] = counts.get(trial.outcome, 0) + 1
    height = 1.6 + (0.24 * len(ordered) if len(ordered) <= LABELLED else min(9.0, 0.04 * len(ordered)))
    return Picture(
        name,
        "Which trial stopped when",
        f"{len(ordered)} trials as bars of env steps, the best score on top: "
        + ", ".join(f"{n} {outcome}" for outcome, n in counts.items())
        + ".",
        f"The best score on top. {unknown}Why each one stopped is in the table of trials.",
        {
            "kind": "stops",
            "bars": [[places[t.folder], float(t.columns["env_steps"][-1])] for t in ordered],
            "outcomes": {o: _LOOK.get(o, (GREY, "."))[0] for o in counts},
            "rungs": lines,
        },
        draw,
        (9.0, height),
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
