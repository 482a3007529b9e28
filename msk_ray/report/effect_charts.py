"""Charts of the effect of parameters on the score: ranked effects, and all trials over all parameters."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from msk_ray.experiment.records import TrialRecord
from msk_ray.experiment.trial import short_key
from msk_ray.report.charts import (
    BLUE,
    GREY,
    INK,
    PALETTE,
    Axis,
    Bars,
    Chart,
    Colour,
    Line,
    Parallel,
    ParallelLine,
    Picture,
    Plot,
    Point,
    Row,
    Style,
    plain,
    rounded,
)
from msk_ray.report.effects import LEAST, Effect, TrialScore
from msk_ray.report.reading import Reading
from msk_ray.report.statistics import mean_interval
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
_PARAMETER, _SEED, _TRIAL, _MEAN, _INTERVAL = range(5)
_STYLES = (
    Style(BLUE),
    Style(GREY),
    Style(INK, opacity=0.8, marker="o"),
    Style(PALETTE[1], marker="_"),
    Style(PALETTE[1], width=1.6),
)
_DECADES = 30.0
"""Numbers whose largest is more than this many times the smallest are drawn on a logarithmic axis."""


def parameter_effects(ranked: Sequence[Effect], name: str) -> Picture | None:
    """Parameters ranked, and the scores at each level of the first ones; None if no two levels have a score."""
    drawn = [effect for effect in ranked if effect.spread is not None]
    if not drawn:
        return None
    panels = drawn[:PANELS]
    shares = any(effect.share is not None for effect in drawn)

    first = drawn[0]
    share = "" if first.share is None else f", {max(0.0, first.share):.0%} of the variance"
    return Picture(
        name,
        f"{len(drawn)} parameters ranked by their effect on the best score. First: {first.factor}{share}, "
        f"{first.spread:.4g} between its best and its worst level.",
        (
            "First: share of the scores' variance that a parameter explains on its own, minus the share expected by "
            "chance (ω²; Hays 1963). Then: best scores at each level, with their mean and its 95 % bootstrap interval. "
            if shares
            else "First: difference between the mean scores of a parameter's best and worst level, which cannot be "
            "distinguished from chance. Then: the scores. "
        )
        + _too_few_words(ranked)
        + (_CUT_WORDS if any(trial.cut for level in first.trials.values() for trial in level) else ""),
        Chart(_STYLES, (_ranking(drawn, shares), *(_levels_plot(effect) for effect in panels))),
    )


def _too_few_words(ranked: Sequence[Effect]) -> str:
    """Which parameters have too few trained trials for a share of the variance, and where."""
    short = [f"{short_key(effect.factor)} ({effect.too_few})" for effect in ranked if effect.too_few]
    if not short:
        return ""
    more = f" and {len(short) - AXES} more parameters" if len(short) > AXES else ""
    return (
        f"Too few trained trials with a score for the share of the variance, which needs {LEAST} at each "
        f"level: {', '.join(short[:AXES])}{more}. "
    )


def _ranking(drawn: Sequence[Effect], shares: bool) -> Bars:
    """Parameters by their share of the variance, or else by their spread."""
    rows = []
    for effect in drawn:
        value = max(0.0, effect.share or 0.0) if shares else effect.spread or 0.0
        note = _share_text(effect) if shares else f"{effect.spread:.3g}"
        label = printable(short_key(effect.factor))
        style = _SEED if effect.factor == "seed" else _PARAMETER
        rows.append(Row(style, label, rounded(value), note, text=f"{label}: {note}"))
    axis = Axis("share of variance (ω²)", high=1.0) if shares else Axis("spread of mean scores")
    return Bars(axis, tuple(rows))


def _share_text(effect: Effect) -> str:
    if effect.share is None:
        return "too few trials"
    return f"{effect.share:.2f}" if effect.share > 0.0 else "≤ 0"


def _drawn_levels(effect: Effect) -> tuple[str, list[tuple[str, list[TrialScore]]]]:
    """A parameter's name, and its levels with their trials; of many, the best and the worst."""
    levels = [(level, effect.with_score(level)) for level in effect.levels]
    title = short_key(effect.factor)
    if len(levels) > LEVELS:
        # Too many to tell apart.
        ordered = sorted(levels, key=lambda level: -float(np.mean(effect.levels[level[0]])))
        title += f" (best and worst of {len(levels)})"
        levels = [*ordered[: LEVELS // 2], *ordered[-LEVELS // 2 :]]
    return title, levels


def _levels_plot(effect: Effect) -> Plot:
    """The scores at each level, side by side, with their mean and its interval."""
    title, levels = _drawn_levels(effect)
    lines, points = [], []
    for place, (label, trials) in enumerate(levels):
        scores = effect.levels[label]
        mean, interval = rounded(float(np.mean(scores))), mean_interval(scores)
        text = f"{title} = {printable(label)}\nmean {mean:.5g}"
        if interval is not None:
            text += f", 95 % interval {interval.low:.5g} … {interval.high:.5g}"
            lines.append(Line(_INTERVAL, [place, place], plain([interval.low, interval.high])))
        spots = place + np.linspace(-0.15, 0.15, len(trials)) if len(trials) > 1 else [place]
        for spot, trial, score in zip(spots, trials, scores, strict=True):
            note = f"best score {score:.5g}" + (" so far: stopped before its end" if trial.cut else "")
            points.append(Point(_TRIAL, rounded(spot), rounded(score), trial.place, note, trial.cut))
        points.append(Point(_MEAN, place, mean, text=text))
    axis = Axis(low=-0.6, high=len(levels) - 0.4, labels=tuple(printable(label) for label, _ in levels))
    return Plot(axis, Axis("best score"), tuple(lines), tuple(points), title)


def parallel_coordinates(
    reading: Reading, ranked: Sequence[Effect], name: str, places: Mapping[Path, int]
) -> Picture | None:
    """One line per trial through its parameters to its score; None with fewer than two trials or no parameter."""
    factors = [effect.factor for effect in ranked if effect.factor != "seed" and effect.spread is not None][:AXES]
    trials = [t for t in reading.trials if t.score is not None and all(f in t.trial.changed for f in factors)]
    if len(trials) < 2 or not factors:
        return None
    trials.sort(key=lambda t: t.score or 0.0)
    scores = [t.score or 0.0 for t in trials]
    columns = [_column(factor, trials) for factor in factors]
    columns.append((Axis("best score"), scores))
    low, high = scores[0], scores[-1]
    lines = tuple(
        ParallelLine(
            _score_colour((score - low) / (high - low or 1.0)),
            plain(values[i] for _, values in columns),
            places[trial.folder],
            f"best score {score:.5g}",
        )
        for i, (trial, score) in enumerate(zip(trials, scores, strict=True))
    )
    return Picture(
        name,
        f"Parallel coordinates of {len(trials)} trials over {', '.join(short_key(f) for f in factors)} and the best "
        f"score; the best has {trials[-1].trial.variant}.",
        "Each line is a trial, coloured by its best score. Numbers that span a factor of 30 are on a logarithmic axis.",
        Chart((), (Parallel(tuple(axis for axis, _ in columns), lines),)),
    )


def _score_colour(share: float) -> Colour:
    """Viridis, on each paper without the end that is hard to see there."""
    ramp = colormaps["viridis"]
    return to_hex(ramp(0.88 * share)), to_hex(ramp(0.22 + 0.78 * share))


def _column(factor: str, trials: Sequence[TrialRecord]) -> tuple[Axis, list[float]]:
    """A parameter's axis, and the trials' values on it: numbers, or positions of its levels."""
    name = printable(short_key(factor))
    values = [trial.trial.values.get(factor) for trial in trials]
    if all(_is_number(value) for value in values) and len(set(values)) > 1:
        numbers = [float(value) for value in values if value is not None]
        low, high = min(numbers), max(numbers)
        if low > 0.0 and high > _DECADES * low:
            return Axis(name, "log", low, high), numbers
        return Axis(name), numbers
    texts = [printable(trial.trial.changed[factor]) for trial in trials]
    levels = list(
        dict.fromkeys(printable(t.trial.changed[factor]) for t in sorted(trials, key=lambda t: t.trial.index))
    )
    return Axis(name, labels=tuple(levels)), [levels.index(text) for text in texts]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
