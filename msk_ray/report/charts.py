"""Charts as plain descriptions, which `page/charts.js` draws.

Colours are a string, or a pair of them for light and for dark paper. Trials are named by their position in the page's
list of trials. What has a `trial` is shown while the reader's filter shows this trial, and leads to it.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.ticker import EngFormatter

Colour = str | tuple[str, str]
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8B5A2B", "#4B0082")
"""Colours that can be distinguished with any colour vision (Okabe and Ito 2008, with two added at the end)."""
GREY = "#9a9a9a"
BLUE = ("#0072B2", "#56B4E9")
INK = ("#57606a", "#9da7b3")
DASHES = ("-", "--", "-.", ":")

POINTS = 300
"""Maximum number of points of a drawn curve."""
CHART_POINTS = 60_000
"""About how many points of all its lines together a chart has: more would make the page large and slow."""
_LEAST_POINTS = 12

Numbers = list[float | None]


@dataclass(frozen=True)
class Floor:
    """Where an axis of scores ends although curves go lower."""

    at: float
    text: str
    """How many do, and how far."""


@dataclass(frozen=True)
class Axis:
    """An axis and the range that it shows."""

    name: str = ""
    scale: Literal["linear", "log", "count"] = "linear"
    """A count is labelled in thousands and millions."""
    low: float | None = None
    """None, here and below: what fits the data."""
    high: float | None = None
    labels: tuple[str, ...] = ()
    """Names of the positions 0, 1, 2, …, for an axis of levels."""
    floor: Floor | None = None


@dataclass(frozen=True)
class Style:
    """A look, and its entry in the legend."""

    colour: Colour
    name: str = ""
    """In the legend, where readers of the page can switch it off; empty: it has no entry."""
    dash: str = "-"
    """One of DASHES."""
    width: float = 1.0
    opacity: float = 1.0
    marker: Literal["", "o", "x", "_"] = ""
    """Of points."""


@dataclass(frozen=True)
class Line:
    """A line, with a band around it if it has edges."""

    style: int
    """Position in the chart's styles, here and below."""
    x: Numbers
    y: Numbers
    trial: int | None = None
    text: str = ""
    """What the pointer reads beside the numbers; a trial's name comes by itself."""
    low: Numbers | None = None
    """Lower and upper edge of the band at `x`."""
    high: Numbers | None = None
    when: Literal["always", "unfiltered", "filtered"] = "always"
    """`unfiltered`: until the reader filters trials; `filtered`: from then on, in its place."""


@dataclass(frozen=True)
class Point:
    """A point."""

    style: int
    x: float
    y: float
    trial: int | None = None
    text: str = ""
    hollow: bool = False


@dataclass(frozen=True)
class Plot:
    """Lines and points, later ones above earlier ones and points above lines."""

    x: Axis
    y: Axis
    lines: tuple[Line, ...] = ()
    points: tuple[Point, ...] = ()
    title: str = ""
    kind: Literal["plot"] = "plot"


@dataclass(frozen=True)
class Row:
    """A horizontal bar from 0."""

    style: int
    label: str
    value: float
    note: str = ""
    """Written beside the bar."""
    trial: int | None = None
    text: str = ""


@dataclass(frozen=True)
class Bars:
    """Rows from top to bottom, and dotted lines across them."""

    x: Axis
    rows: tuple[Row, ...]
    rules: tuple[float, ...] = ()
    rule_name: str = ""
    title: str = ""
    kind: Literal["bars"] = "bars"


@dataclass(frozen=True)
class ParallelLine:
    """A trial's line through parallel axes."""

    colour: Colour
    values: Numbers
    """One for each axis: a number, or the position of a level."""
    trial: int
    text: str = ""


@dataclass(frozen=True)
class Parallel:
    """Parallel axes with a line for each trial, later ones above earlier ones."""

    axes: tuple[Axis, ...]
    lines: tuple[ParallelLine, ...]
    title: str = ""
    kind: Literal["parallel"] = "parallel"


@dataclass(frozen=True)
class Chart:
    """One or more panels with one legend."""

    styles: tuple[Style, ...]
    panels: tuple[Plot | Bars | Parallel, ...]
    zoom: bool = False
    """Whether readers of the page can zoom."""


@dataclass(frozen=True)
class Picture:
    """A chart of the report, with its words."""

    name: str
    """Its name on the page."""
    alt: str
    """Description of what it shows."""
    caption: str
    chart: Chart


def points_each(lines: int) -> int:
    """How many points each of a chart's lines may have."""
    return max(_LEAST_POINTS, min(POINTS, CHART_POINTS // max(1, lines)))


def plain(values: Iterable[float]) -> Numbers:
    """Numbers with five digits; None for what is not finite."""
    return [rounded(value) if math.isfinite(value) else None for value in values]


def rounded(value: float) -> float:
    """The number with five digits."""
    return float(f"{value:.5g}")


def format_steps(steps: float) -> str:
    """1.5M, 20.0k, 800."""
    return EngFormatter(sep="", places=1)(steps) if steps >= 1000.0 else f"{steps:.0f}"


def thin_evenly(x: np.ndarray, y: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `count` + 2 points of a curve (N,): evenly spaced ones with both ends, and the extremes of `y`."""
    if len(x) <= count:
        return x, y
    keep = np.unique([*np.linspace(0, len(x) - 1, count).round().astype(int), int(np.argmax(y)), int(np.argmin(y))])
    return x[keep], y[keep]


def thin_peaks(x: np.ndarray, y: np.ndarray, count: int = POINTS) -> tuple[np.ndarray, np.ndarray]:
    """A curve (N,) over `x` with at most `count` points: the largest value of each stretch, at its position."""
    if len(x) <= count:
        return x, y
    stretch = math.ceil(len(x) / count)
    padded = np.full(stretch * math.ceil(len(x) / stretch), -np.inf)
    padded[: len(y)] = np.where(np.isnan(y), -np.inf, y)
    blocks = padded.reshape(-1, stretch)
    keep = blocks.argmax(1) + stretch * np.arange(len(blocks))
    return x[keep], y[keep]
