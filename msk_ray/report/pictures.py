"""Pictures of the page: each drawn twice with matplotlib, for a wide screen or paper and for a phone."""

import io
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from msk_ray.text import printable

Draw = Callable[[Figure, bool], None]
"""Draws into an empty figure; told whether it is the narrow one."""

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8B5A2B", "#4B0082")
"""Colours that can be distinguished with any colour vision (Okabe and Ito 2008, with two added at the end)."""
DASHES = ("-", "--", "-.", ":")
GREY = "#9a9a9a"
POINTS = 300
"""Maximum number of points of a drawn curve."""
_WIDE_DPI, _NARROW_DPI = 120, 150


@dataclass(frozen=True)
class Picture:
    """A figure of the page."""

    name: str
    """Name of its file without suffix."""
    title: str
    alt: str
    """Description of what it shows."""
    caption: str
    wide: bytes
    """PNG."""
    narrow: bytes | None
    """PNG for screens up to 600 pixels; None: the wide one."""


def picture(
    name: str,
    title: str,
    alt: str,
    caption: str,
    draw: Draw,
    wide: tuple[float, float] = (9.0, 5.0),
    narrow: tuple[float, float] = (4.2, 4.6),
) -> Picture:
    """Draw a picture in both sizes [inches]."""
    return Picture(name, title, alt, caption, _png(draw, wide, False), _png(draw, narrow, True))


def _png(draw: Draw, size: tuple[float, float], narrow: bool) -> bytes:
    figure = Figure(figsize=size, layout="constrained")
    draw(figure, narrow)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_NARROW_DPI if narrow else _WIDE_DPI)
    return buffer.getvalue()


def thin_peaks(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A curve (N,) over `x` with at most POINTS points: the largest value of each stretch, at its position."""
    if len(x) <= POINTS:
        return x, y
    stretch = math.ceil(len(x) / POINTS)
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
    """1.5M, 20k."""
    return EngFormatter(sep="", places=1)(steps)
