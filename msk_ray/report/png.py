"""Charts as PNG, for print and papers."""

import io
import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, Formatter, ScalarFormatter

from msk_ray.report.charts import Axis, Bars, Chart, Colour, Numbers, Parallel, Plot, Style
from msk_ray.text import printable

LABELLED = 60
"""Maximum number of rows that are named."""
_DPI = 120
_WIDTH = 9.0
_ALONE = 5.0
"""Height of a plot that has no other beside it [inches]."""


def png(chart: Chart) -> bytes:
    """The chart as PNG: bars on the left, plots in two columns."""
    bars = [panel for panel in chart.panels if isinstance(panel, Bars)]
    others = [panel for panel in chart.panels if not isinstance(panel, Bars)]
    rows = math.ceil(len(others) / 2)
    height = max([_bars_height(panel) for panel in bars], default=0.0)
    height = max(height, _ALONE if rows == 1 else 1.0 + 2.3 * rows if rows else 0.0)
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    sides: Any = figure.subfigures(1, 2, width_ratios=(1.0, 1.6)) if bars and others else (figure, figure)
    for panel in bars:
        _draw_bars(sides[0].add_subplot(), panel, chart.styles)
    if others:
        grid = sides[1].subplots(rows, min(2, len(others)), squeeze=False).ravel()
        for axes in grid[len(others) :]:
            axes.set_axis_off()
        for axes, other in zip(grid, others, strict=False):
            if isinstance(other, Plot):
                _draw_plot(axes, other, chart.styles, small=len(chart.panels) > 1)
            else:
                _draw_parallel(axes, other)
    _draw_legend(figure, chart)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    return buffer.getvalue()


def shorten(text: str, length: int) -> str:
    """`text` on one line, cut to `length` characters, where a dollar sign must not start a formula."""
    line = printable(text)
    return (line if len(line) <= length else line[: length - 1] + "…").replace("$", "\\$")


def _draw_legend(figure: Figure, chart: Chart) -> None:
    bars = next((panel for panel in chart.panels if isinstance(panel, Bars)), None)
    handles = []
    for style in chart.styles:
        look: dict[str, Any] = {"color": _on_paper(style.colour), "linestyle": style.dash, "linewidth": style.width}
        marker = style.marker if bars else ""
        handles.append(Line2D([], [], marker=marker, label=shorten(style.name, 44), **look))
    if bars and bars.rules:
        handles.append(Line2D([], [], color="black", linestyle=":", label=bars.rule_name))
    handles = [handle for handle in handles if handle.get_label()]
    if sum(len(str(handle.get_label())) + 6 for handle in handles) > 240:
        figure.legend(handles=handles, fontsize=8, loc="outside right upper")
    elif handles:
        figure.legend(handles=handles, fontsize=8, loc="outside upper center", ncols=min(5, len(handles)))


def _draw_plot(axes: Axes, plot: Plot, styles: tuple[Style, ...], small: bool) -> None:
    lines = [line for line in plot.lines if line.when != "filtered"]
    # One collection a style: thousands of lines, each on its own, take minutes.
    for number in dict.fromkeys(line.style for line in lines):
        style = styles[number]
        paths = [np.column_stack((_floats(line.x), _floats(line.y))) for line in lines if line.style == number]
        look: dict[str, Any] = {"colors": _on_paper(style.colour), "linewidths": style.width, "alpha": style.opacity}
        axes.add_collection(LineCollection(paths, linestyles=style.dash, **look))
    for line in lines:
        if line.low is not None and line.high is not None:
            edges = _floats(line.x), _floats(line.low), _floats(line.high)
            axes.fill_between(*edges, color=_on_paper(styles[line.style].colour), alpha=0.16, linewidth=0)
    for point in plot.points:
        style = styles[point.style]
        colour = _on_paper(style.colour)
        size, edge = {"_": (13.0, 2.0), "x": (7.0, 2.0)}.get(style.marker, (3.5, 1.0))
        look = {"markersize": size, "markeredgewidth": edge, "alpha": style.opacity}
        inside = "none" if point.hollow else colour
        axes.plot(point.x, point.y, style.marker, color=colour, markerfacecolor=inside, **look)
    axes.autoscale_view()
    axes.set_title(shorten(plot.title, 60), fontsize=9)
    _set_axis(axes, "x", plot.x, small)
    _set_axis(axes, "y", plot.y, small)
    if plot.y.floor is not None:
        top = max(float(np.nanmax(_floats(line.high or line.y))) for line in lines)
        axes.set_ylim(plot.y.floor.at, top + 0.05 * (top - plot.y.floor.at))
        axes.text(0.01, 0.01, plot.y.floor.text, transform=axes.transAxes, fontsize=8, color="#a03000")
    axes.grid(alpha=0.3, axis="y" if plot.x.labels else "both")


def _set_axis(axes: Axes, which: str, axis: Axis, small: bool) -> None:
    size = 8 if small else 10
    own = axes.xaxis if which == "x" else axes.yaxis
    axes.tick_params(axis=which, labelsize=size)  # type: ignore[arg-type]
    own.set_label_text(shorten(axis.name, 60), fontsize=size)
    if which == "x":
        axes.margins(x=0.02)
    if axis.labels:
        axes.set_xlim(axis.low, axis.high)
        slanted = max(map(len, axis.labels)) > 6 or len(axis.labels) > 5
        # A slanted label ends at its tick; centred labels would overlap.
        turned: dict[str, Any] = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"} if slanted else {}
        own.set_ticks(range(len(axis.labels)), [shorten(label, 18) for label in axis.labels], fontsize=7, **turned)
    elif axis.scale == "log":
        axes.set_yscale("log")
    else:
        formatter: Formatter = EngFormatter(sep="") if axis.scale == "count" else ScalarFormatter()
        own.set_major_formatter(formatter)


def _bars_height(bars: Bars) -> float:
    return 1.6 + (0.24 * len(bars.rows) if len(bars.rows) <= LABELLED else min(9.0, 0.04 * len(bars.rows)))


def _draw_bars(axes: Axes, bars: Bars, styles: tuple[Style, ...]) -> None:
    """A row whose style has a marker is a line that ends in it: a marker can be told without its colour."""
    named = len(bars.rows) <= LABELLED
    for place, row in enumerate(bars.rows):
        style = styles[row.style]
        colour = _on_paper(style.colour)
        if style.marker:
            axes.plot([0.0, row.value], [place, place], color=colour, linewidth=2.5 if named else 1.2, alpha=0.7)
            axes.plot(row.value, place, style.marker, color=colour, markersize=7 if named else 4)
        else:
            axes.barh(place, row.value, color=colour, height=0.65)
        axes.text(row.value, place, f" {shorten(row.note, 40)}", va="center", fontsize=8)
    for rule in bars.rules:
        axes.axvline(rule, color="black", linestyle=":", linewidth=0.9)
    if any(row.note for row in bars.rows):
        axes.set_xlim(0.0, 1.15 * bars.x.high if bars.x.high else 1.25 * max(row.value for row in bars.rows) or None)
    axes.set_ylim(max(len(bars.rows), 5) - 0.4, -0.6)
    labels = [shorten(row.label, 48) for row in bars.rows]
    axes.set_yticks(range(len(labels)) if named else [], labels if named else [], fontsize=7)
    _set_axis(axes, "x", bars.x, small=True)
    axes.grid(alpha=0.3, axis="x")


def _draw_parallel(axes: Axes, parallel: Parallel) -> None:
    positions = np.arange(len(parallel.axes))
    scales = [_heights(axis, [line.values[i] for line in parallel.lines]) for i, axis in enumerate(parallel.axes)]
    heights = np.column_stack([own for own, _ in scales])
    colours = [_on_paper(line.colour) for line in parallel.lines]
    paths = [np.column_stack((positions, row)) for row in heights]
    axes.add_collection(LineCollection(paths, colors=colours, linewidths=1.0, alpha=0.75))
    box = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.6}
    for position, (_, ticks) in enumerate(scales):
        axes.axvline(position, color="black", linewidth=0.8)
        for height, label in ticks:
            axes.text(position + 0.03, height, shorten(label, 16), fontsize=7, ha="left", va="center", bbox=box)
    axes.set_xticks(positions, [shorten(axis.name, 18) for axis in parallel.axes], fontsize=8)
    axes.set_yticks([])
    axes.set_xlim(-0.05, positions[-1] + 0.35)
    axes.set_ylim(-0.05, 1.05)
    for side in axes.spines.values():
        side.set_visible(False)


def _heights(axis: Axis, values: Numbers) -> tuple[np.ndarray, list[tuple[float, str]]]:
    """Heights (N,) of some values on an axis from 0 to 1, and its ticks as (height, text)."""
    if axis.labels:
        last = max(1, len(axis.labels) - 1)
        ticks = [(place / last, label) for place, label in enumerate(axis.labels)]
        return _floats(values) / last, ticks if len(ticks) <= 12 else []
    numbers = np.log10(_floats(values)) if axis.scale == "log" else _floats(values)
    low, high = float(numbers.min()), float(numbers.max())
    different = np.unique(numbers)
    marks = different if len(different) <= 6 else np.linspace(low, high, 6)
    span = high - low or 1.0
    texts = 10.0**marks if axis.scale == "log" else marks
    ticks = [((mark - low) / span, f"{text:.4g}") for mark, text in zip(marks, texts, strict=True)]
    return (numbers - low) / span, ticks


def _on_paper(colour: Colour) -> str:
    return colour if isinstance(colour, str) else colour[0]


def _floats(values: Numbers) -> np.ndarray:
    return np.array(values, dtype=float)
