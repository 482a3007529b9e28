"""Figures of the report: each as data, from which the page draws a chart, and as a PNG for papers."""

import io
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from msk_ray.text import printable

Draw = Callable[[Figure], None]
"""Draws into an empty figure."""

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8B5A2B", "#4B0082")
"""Colours that can be distinguished with any colour vision (Okabe and Ito 2008, with two added at the end)."""
DASHES = ("-", "--", "-.", ":")
GREY = "#9a9a9a"
POINTS = 300
"""Maximum number of points of a drawn curve."""
CHART_POINTS = 60_000
"""About how many points of all its lines together a chart has: more would make the page large and slow."""
_LEAST_POINTS = 12
_DPI = 120


@dataclass(frozen=True)
class Picture:
    """A figure of the report."""

    name: str
    """Name of its file without suffix."""
    title: str
    alt: str
    """Description of what it shows."""
    caption: str
    chart: Mapping[str, Any]
    """What the page draws, as plain data: its `kind`, and the fields that `page/charts.js` reads for this kind. Trials
    are named by their position in the page's list of trials."""
    draw: Draw
    """Draws the same with matplotlib."""
    size: tuple[float, float] = (9.0, 5.0)
    """Width and height of the PNG [inches]."""

    def png(self) -> bytes:
        """The figure as PNG."""
        figure = Figure(figsize=self.size, layout="constrained")
        self.draw(figure)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI)
        return buffer.getvalue()


def points_each(lines: int) -> int:
    """How many points each of a chart's lines may have."""
    return max(_LEAST_POINTS, min(POINTS, CHART_POINTS // max(1, lines)))


def plain(values: Iterable[float]) -> list[float | None]:
    """Numbers with five digits for a chart; None for what is not finite."""
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in values]


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


def steps_axis(axes: Axes) -> None:
    """Env steps along x, in thousands and millions."""
    axes.set_xlabel("env steps")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.margins(x=0.02)


def shorten(text: str, length: int) -> str:
    """`text` on one line, cut to `length` characters, for a picture, where a dollar sign must not start a formula."""
    line = printable(text)
    return (line if len(line) <= length else line[: length - 1] + "…").replace("$", "\\$")


def format_steps(steps: float) -> str:
    """1.5M, 20.0k, 800."""
    return EngFormatter(sep="", places=1)(steps) if steps >= 1000.0 else f"{steps:.0f}"
