"""Pictures of the effect of parameters on the score: ranked effects, and all trials over all parameters."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from msk_ray.experiment.trial import short_key
from msk_ray.report.pictures import GREY, PALETTE, Picture, plain, shorten
from msk_ray.report.reading import Reading, TrialReading
from msk_ray.report.statistics import LEAST, Effect, Scored, effects, mean_interval
from msk_ray.text import printable

PANELS = 4
"""Number of parameters whose levels are drawn."""
LEVELS = 16
"""Maximum number of drawn levels of a parameter; if there are more, the best and the worst ones."""
AXES = 8
"""Maximum number of parameters in the parallel coordinates."""
_CUT_WORDS = (
    "Open circles are trials that were stopped before their end or are still running, with their best score so far, "
    "which might have risen further: the effects are those of this sweep, not of complete runs. "
)
_DECADES = 30.0
"""Numbers whose largest is more than this many times the smallest are drawn on a logarithmic axis."""


def ranked_effects(reading: Reading, places: Mapping[Path, int]) -> list[Effect]:
    """Effects of the experiment's parameters on the best score, the largest first.

    Args:
        places: trials' positions in the page's list.
    """
    return effects(
        [
            Scored(t.trial.changed, t.trial.values, t.trial.seed, t.score, t.cut, places[t.folder])
            for t in reading.trials
        ]
    )


def parameter_effects(found: Sequence[Effect], name: str) -> Picture | None:
    """Parameters ranked, and the scores at each level of the first ones; None if no two levels have a score."""
    drawn = [effect for effect in found if effect.spread is not None]
    if not drawn:
        return None
    panels = drawn[:PANELS]
    shares = any(effect.share is not None for effect in drawn)

    def draw(figure: Figure) -> None:
        rows = 2 if len(panels) > 2 else 1
        parts: Any = figure.subfigures(1, 2, width_ratios=(1.0, 1.6))
        grid = parts[1].subplots(rows, math.ceil(len(panels) / rows), squeeze=False).ravel()
        for axes in grid[len(panels) :]:
            axes.set_axis_off()
        _draw_ranking(parts[0].add_subplot(), drawn, shares)
        for axes, effect in zip(grid, panels, strict=False):
            _draw_levels(axes, effect)

    first = drawn[0]
    share = "" if first.share is None else f", {max(0.0, first.share):.0%} of the variance"
    return Picture(
        name,
        "What the parameters do",
        f"{len(drawn)} parameters ranked by their effect on the best score. First: {first.factor}{share}, "
        f"{first.spread:.4g} between its best and its worst level.",
        (
            "First: share of the scores' variance that a parameter explains on its own, minus the share expected by "
            "chance (ω²; Hays 1963). Then: best scores at each level, with their mean and its 95 % bootstrap interval. "
            if shares
            else "First: difference between the mean scores of a parameter's best and worst level, which cannot be "
            "distinguished from chance. Then: the scores. "
        )
        + _too_few_words(found)
        + (_CUT_WORDS if any(trial.cut for level in first.trials.values() for trial in level) else ""),
        {
            "kind": "effects",
            "x": "share of variance (ω²)" if shares else "spread of mean scores",
            "ranking": [
                {
                    "name": short_key(e.factor),
                    "value": plain([max(0.0, e.share or 0.0) if shares else e.spread or 0.0])[0],
                    "text": _share_text(e) if shares else f"{e.spread:.3g}",
                    "seed": e.factor == "seed",
                }
                for e in drawn
            ],
            "panels": [_levels_chart(effect) for effect in panels],
        },
        draw,
        (9.0, 5.4),
    )


def _too_few_words(found: Sequence[Effect]) -> str:
    """Which parameters have too few trained trials for a share of the variance, and where."""
    short = [f"{short_key(effect.factor)} ({effect.too_few})" for effect in found if effect.too_few]
    if not short:
        return ""
    more = f" and {len(short) - AXES} more parameters" if len(short) > AXES else ""
    return (
        f"Too few trained trials with a score for the share of the variance, which needs {LEAST} at each "
        f"level: {', '.join(short[:AXES])}{more}. "
    )


def _draw_ranking(axes: Axes, found: Sequence[Effect], shares: bool) -> None:
    values = [max(0.0, e.share or 0.0) if shares else e.spread or 0.0 for e in found]
    places = range(len(found))
    colours = [GREY if effect.factor == "seed" else PALETTE[0] for effect in found]
    axes.barh(places, values, color=colours, height=0.65)
    for place, effect in enumerate(found):
        text = f"{effect.spread:.3g}" if not shares else _share_text(effect)
        axes.text(values[place], place, f" {text}", va="center", fontsize=8)
    axes.set_yticks(places, [shorten(short_key(e.factor), 18) for e in found], fontsize=8)
    axes.set_ylim(max(len(found), 5) - 0.5, -0.5)
    axes.set_xlabel("share of variance (ω²)" if shares else "spread of mean scores", fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
    axes.set_xlim(0.0, 1.12 if shares else 1.25 * max(values) or None)
    axes.grid(alpha=0.3, axis="x")


def _share_text(effect: Effect) -> str:
    if effect.share is None:
        return "too few trials"
    return f"{effect.share:.2f}" if effect.share > 0.0 else "≤ 0"


def _drawn_levels(effect: Effect) -> tuple[str, list[tuple[str, list[Scored]]]]:
    """A parameter's name, and its levels with their trials; of many, the best and the worst."""
    levels = [(level, effect.scored(level)) for level in effect.levels]
    title = short_key(effect.factor)
    if len(levels) > LEVELS:
        # Too many to tell apart.
        ordered = sorted(levels, key=lambda level: -float(np.mean(effect.levels[level[0]])))
        title += f" (best and worst of {len(levels)})"
        levels = [*ordered[: LEVELS // 2], *ordered[-LEVELS // 2 :]]
    return title, levels


def _levels_chart(effect: Effect) -> dict[str, Any]:
    title, levels = _drawn_levels(effect)
    shown = []
    for label, trials in levels:
        scores = effect.levels[label]
        interval = mean_interval(scores)
        shown.append(
            {
                "label": printable(label),
                "mean": plain([float(np.mean(scores))])[0],
                "interval": None if interval is None else plain([interval.low, interval.high]),
                "points": [[t.place, plain([score])[0], t.cut] for t, score in zip(trials, scores, strict=True)],
            }
        )
    return {"title": title, "levels": shown}


def _draw_levels(axes: Axes, effect: Effect) -> None:
    title, levels = _drawn_levels(effect)
    jitter = np.random.default_rng(0)
    for place, (label, trials) in enumerate(levels):
        scores = effect.levels[label]
        spots = place + 0.16 * (jitter.random(len(trials)) - 0.5)
        for trial, score, spot in zip(trials, scores, spots, strict=True):
            inside = "none" if trial.cut else GREY
            axes.plot(spot, score, "o", color=GREY, markerfacecolor=inside, markersize=3.5, alpha=0.8)
        mean, interval = float(np.mean(scores)), mean_interval(scores)
        axes.plot([place - 0.3, place + 0.3], [mean, mean], color=PALETTE[1], linewidth=2)
        if interval is not None:
            axes.plot([place, place], [interval.low, interval.high], color=PALETTE[1], linewidth=1.4)
    slanted = max(len(label) for label, _ in levels) > 6 or len(levels) > 5
    # A slanted label ends at its tick; centred labels would overlap.
    turned: dict[str, Any] = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"} if slanted else {}
    axes.set_xticks(range(len(levels)), [shorten(label, 18) for label, _ in levels], fontsize=7, **turned)
    axes.tick_params(axis="y", labelsize=7)
    axes.set_title(title, fontsize=9)
    axes.set_ylabel("best score", fontsize=8)
    axes.grid(alpha=0.3, axis="y")


def parallel_coordinates(
    reading: Reading, found: Sequence[Effect], name: str, places: Mapping[Path, int]
) -> Picture | None:
    """One line per trial through its parameters to its score; None with fewer than two trials or no parameter."""
    factors = [effect.factor for effect in found if effect.factor != "seed" and effect.spread is not None][:AXES]
    trials = [t for t in reading.trials if t.score is not None and all(f in t.trial.changed for f in factors)]
    if len(trials) < 2 or not factors:
        return None
    scores = np.array([t.score for t in trials], dtype=float)
    columns = [_coordinate(factor, trials) for factor in factors]
    low, high = float(scores.min()), float(scores.max())
    heights = np.column_stack([*(places for places, _ in columns), (scores - low) / (high - low or 1.0)])
    norm = Normalize(low, high)

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        # Without its lightest part, which is hard to see on white.
        ways = ListedColormap(colormaps["viridis"](np.linspace(0.0, 0.88, 256)))
        x = np.arange(heights.shape[1])
        for row in np.argsort(scores):
            axes.plot(x, heights[row], color=ways(norm(scores[row])), linewidth=1.0, alpha=0.75)
        ticks = [labels for _, labels in columns] + [[(0.0, f"{low:.4g}"), (1.0, f"{high:.4g}")]]
        box = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.6}
        for place, own in enumerate(ticks):
            axes.axvline(place, color="black", linewidth=0.8)
            for height, label in own:
                axes.text(place + 0.03, height, shorten(label, 16), fontsize=7, ha="left", va="center", bbox=box)
        axes.set_xticks(x, [shorten(short_key(f), 18) for f in factors] + ["best score"], fontsize=8)
        axes.set_yticks([])
        axes.set_xlim(-0.05, x[-1] + 0.35)
        for side in axes.spines.values():
            side.set_visible(False)
        if high > low:
            bar = figure.colorbar(ScalarMappable(norm, ways), ax=axes, shrink=0.8, pad=0.02)
            bar.set_label("best score", fontsize=8)
            bar.ax.tick_params(labelsize=7)

    best = trials[int(np.argmax(scores))]
    return Picture(
        name,
        "All trials over all parameters",
        f"Parallel coordinates of {len(trials)} trials over {', '.join(short_key(f) for f in factors)} and the best "
        f"score; the best has {best.trial.variant}.",
        "Each line is a trial, coloured by its best score. Numbers that span a factor of 30 are on a logarithmic axis.",
        {
            "kind": "parallel",
            "axes": [_axis_chart(factor, trials) for factor in factors],
            "trials": [[places[t.folder], plain([t.score or 0.0])[0]] for t in trials],
        },
        draw,
        (9.0, 4.6),
    )


def _numbers(factor: str, trials: Sequence[TrialReading]) -> tuple[list[float] | None, bool]:
    """The trials' values of a parameter whose values are numbers, and whether its axis is logarithmic; None if it has
    levels instead."""
    values = [trial.trial.values.get(factor) for trial in trials]
    if not all(_is_number(value) for value in values) or len(set(values)) < 2:
        return None, False
    numbers = [float(value) for value in values if value is not None]
    return numbers, min(numbers) > 0.0 and max(numbers) > _DECADES * min(numbers)


def _axis_chart(factor: str, trials: Sequence[TrialReading]) -> dict[str, Any]:
    numbers, logarithmic = _numbers(factor, trials)
    name = short_key(factor)
    if numbers is not None:
        return {"name": name, "log": logarithmic, "values": plain(numbers)}
    labels = [printable(trial.trial.changed[factor]) for trial in trials]
    levels = list(dict.fromkeys(labels))
    return {"name": name, "levels": levels, "values": [levels.index(label) for label in labels]}


def _coordinate(factor: str, trials: Sequence[TrialReading]) -> tuple[np.ndarray, list[tuple[float, str]]]:
    """Heights (N,) from 0 to 1 of the trials on a parameter's axis, and the axis' labels as (height, text)."""
    own, logarithmic = _numbers(factor, trials)
    if own is not None:
        numbers = np.log10(own) if logarithmic else np.array(own)
        heights = (numbers - numbers.min()) / (numbers.max() - numbers.min())
        texts = [f"{value:.4g}" for value in own]
        marks = dict(zip(heights.round(6).tolist(), texts, strict=True))
        chosen = sorted(marks)
        if len(chosen) > 6:
            chosen = [chosen[round(share * (len(chosen) - 1))] for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
        return heights, [(height, marks[height]) for height in dict.fromkeys(chosen)]
    labels = [trial.trial.changed[factor] for trial in trials]
    levels = list(dict.fromkeys(labels))
    places = {label: place / max(1, len(levels) - 1) for place, label in enumerate(levels)}
    shown = levels if len(levels) <= 12 else []
    return np.array([places[label] for label in labels]), [(places[label], label) for label in shown]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
