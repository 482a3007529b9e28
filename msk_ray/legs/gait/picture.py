"""The gait as a picture: curves over the cycle with human landmarks, and measures with human ranges."""

from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle

from msk_ray.legs.gait.compare import BAND
from msk_ray.legs.gait.people import curve, envelope, pace
from msk_ray.legs.gait.ranges import LANDMARKS

_PANELS = {
    "hip_flexion": "hip flexion [°]",
    "knee_flexion": "knee flexion [°]",
    "ankle_dorsiflexion": "ankle dorsiflexion [°]",
    "vertical_force": "vertical force [body weights]",
    "forward_force": "forward force [body weights]",
}
_COLOURS = {"r": "tab:red", "l": "tab:blue"}


def draw(gait: dict[str, Any], title: str, path: Path) -> None:
    """Write a PNG of the result of `measure`: curves of both legs over the mean ± 2 SD of people, and measures."""
    muscles = [name for name, by_side in gait["activations"].items() if by_side["r"] or by_side["l"]]
    figure, axes = plt.subplots(3 if muscles else 2, 4 if muscles else 3, figsize=(16, 10), constrained_layout=True)
    panels = list(axes.flat)
    for name, label in _PANELS.items():
        axis = panels.pop(0)
        people = curve(name)
        _band(axis, people.mean - BAND * people.sd, people.mean + BAND * people.sd)
        for landmark in LANDMARKS.values():
            if landmark.curve == name:
                _box(axis, landmark.phase, landmark.range.least, landmark.range.most)
        _sides(axis, gait["curves"][name])
        axis.set(xlabel="gait cycle from foot strike [%]", ylabel=label, xlim=(0, 100))
    if gait["strides"]:
        axes.flat[0].legend(frameon=False)
    for name in muscles:
        axis = panels.pop(0)
        _sides(axis, gait["activations"][name])
        measured = envelope(name).mean
        # The unit of an electromyogram is not that of an activation: it is drawn to the height of the policy's.
        height = max(max(side["mean"]) for side in gait["activations"][name].values() if side)
        _band(axis, np.zeros(101), measured / measured.max() * height)
        axis.set(xlabel="gait cycle from foot strike [%]", ylabel=f"activation, {name}", xlim=(0, 100))
    _table(panels[-1], gait)
    for axis in panels[:-1]:
        axis.axis("off")
    strides = f"{gait['strides']} strides in {gait['episodes']} episodes"
    figure.suptitle(f"{title}: {strides}; green: people, mean ± 2 SD (boxes: ranges of textbooks; muscles: timing)")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_speeds(gaits: Sequence[tuple[float, dict[str, Any]]], title: str, path: Path) -> None:
    """Write a PNG of cadence and step length against speed, over the mean ± 2 SD of people.

    Args:
        gaits: what the policy was told [m/s], and the result of `measure`.
        title: above the picture.
        path: file to write.
    """
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5), constrained_layout=True)
    told = [speed for speed, _ in gaits]
    speeds = np.linspace(min(told) - 0.1, max(told) + 0.1, 61)
    people = [pace(float(speed)) for speed in speeds]
    for axis, name, label in zip(
        axes, ("cadence", "step_length"), ("cadence [steps/min]", "step length [m]"), strict=True
    ):
        mean = np.array([getattr(one, name) for one in people])
        sd = np.array([getattr(one, f"{name}_sd") for one in people])
        axis.plot(speeds, mean, color="tab:green", label="people, mean ± 2 SD")
        axis.fill_between(speeds, mean - BAND * sd, mean + BAND * sd, color="tab:green", alpha=0.15, linewidth=0)
        found = [
            (gait["measures"]["speed"]["value"], gait["measures"][name]["value"])
            for _, gait in sorted(gaits, key=itemgetter(0))
        ]
        known = np.array([point for point in found if None not in point], dtype=float).reshape(-1, 2)
        axis.plot(*known.T, "o-", color="tab:red", label="policy")
        axis.set(xlabel="speed [m/s]", ylabel=label)
    axes[0].legend(frameon=False)
    figure.suptitle(f"{title}, told {', '.join(f'{speed:g}' for speed in told)} m/s")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _sides(axis: Any, by_side: dict[str, Any]) -> None:
    """Mean curves of both legs with their spread over strides."""
    phase = np.arange(101)
    for side, colour in _COLOURS.items():
        found = by_side[side]
        if found is not None:
            mean, std = np.array(found["mean"]), np.array(found["std"])
            axis.plot(phase, mean, color=colour, label="right" if side == "r" else "left")
            axis.fill_between(phase, mean - std, mean + std, color=colour, alpha=0.2, linewidth=0)


def _band(axis: Any, low: Any, high: Any) -> None:
    axis.fill_between(np.arange(101), low, high, color="tab:green", alpha=0.15, linewidth=0)


def _box(axis: Any, phase: tuple[float, float], least: float, most: float) -> None:
    left, right = (phase[0] - 2, phase[1] + 2) if phase[0] == phase[1] else phase
    axis.add_patch(Rectangle((left, least), right - left, most - least, color="tab:green", alpha=0.25, linewidth=0))
    axis.autoscale_view()


def _table(axis: Any, gait: dict[str, Any]) -> None:
    axis.axis("off")
    rows = [["gait distance", f"{gait['gait_distance']:.3g}", "about 1", "SD of people"]]
    for name, entry in gait["measures"].items():
        value = "–" if entry["value"] is None else f"{entry['value']:.3g}"
        low, high = entry["human"]
        rows.append([name.replace("_", " "), value, f"{low:g} … {high:g}", entry["unit"]])
    for name, value in gait["costs"].items():
        rows.append([name.replace("_", " "), "–" if value is None else f"{value:.3g}", "", ""])
    rows.append(["falls", "–" if gait["falls"] is None else f"{gait['falls']:.0%}", "", "of episodes"])
    table = axis.table(rows, colLabels=["", "policy", "people", ""], loc="center", cellLoc="left")
    table.auto_set_font_size(False)
    table.set_fontsize(8)
    table.auto_set_column_width(range(4))
