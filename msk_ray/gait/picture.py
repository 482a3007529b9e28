"""The gait as a picture: curves over the cycle with human landmarks, and measures with human ranges."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle

from msk_ray.envs.legs.gait.ranges import LANDMARKS

_PANELS = {
    "hip_flexion": "hip flexion [°]",
    "knee_flexion": "knee flexion [°]",
    "ankle_dorsiflexion": "ankle dorsiflexion [°]",
    "vertical_force": "vertical force [body weights]",
    "forward_force": "forward force [body weights]",
}
_COLOURS = {"r": "tab:red", "l": "tab:blue"}


def draw(gait: dict[str, Any], title: str, path: Path) -> None:
    """Write a PNG of the result of `measure`."""
    figure, axes = plt.subplots(2, 3, figsize=(13, 7), constrained_layout=True)
    phase = np.arange(101)
    for axis, (name, label) in zip(axes.flat, _PANELS.items(), strict=False):
        for landmark in LANDMARKS.values():
            if landmark.curve == name:
                _box(axis, landmark.phase, landmark.range.least, landmark.range.most)
        for side, colour in _COLOURS.items():
            curve = gait["curves"][name][side]
            if curve is not None:
                mean, std = np.array(curve["mean"]), np.array(curve["std"])
                axis.plot(phase, mean, color=colour, label="right" if side == "r" else "left")
                axis.fill_between(phase, mean - std, mean + std, color=colour, alpha=0.2, linewidth=0)
        axis.set(xlabel="gait cycle from foot strike [%]", ylabel=label, xlim=(0, 100))
    if gait["strides"]:
        axes.flat[0].legend(frameon=False)
    _table(axes.flat[-1], gait)
    figure.suptitle(f"{title}: {gait['strides']} strides in {gait['episodes']} episodes; green: healthy adults")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _box(axis: Any, phase: tuple[float, float], least: float, most: float) -> None:
    left, right = (phase[0] - 2, phase[1] + 2) if phase[0] == phase[1] else phase
    axis.add_patch(Rectangle((left, least), right - left, most - least, color="tab:green", alpha=0.25, linewidth=0))
    axis.autoscale_view()


def _table(axis: Any, gait: dict[str, Any]) -> None:
    axis.axis("off")
    rows = []
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
