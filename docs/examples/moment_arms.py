"""Draws the moment arms and fibre lengths of myoleg26 over joint angles, beside the published ranges.

python docs/examples/moment_arms.py docs/img/myoleg26_moment_arms.png
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from matplotlib.patches import Rectangle

from msk_ray.config import PhysicsConfig
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.legs.myoleg26.model import WINDOW, build_myoleg26
from msk_ray.legs.myoleg26.moment_arms import PUBLISHED, moment_arms
from msk_ray.legs.myoleg26.tables import MUSCLES

AXES = ("hip_flexion", "hip_adduction", "knee_angle", "ankle_angle")


def fibre_spans(model: mujoco.MjModel) -> dict[str, tuple[float, float, float]]:
    """Shortest, standing and longest fibre length [optimal lengths] of the right leg's muscles."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    mujoco.mj_fwdPosition(model, data)
    found = {}
    for muscle in MUSCLES:
        i = model.actuator(f"{muscle.name}_r").id
        low, high = model.actuator_gainprm[i, :2]
        shortest, longest = model.actuator_lengthrange[i]
        share = (data.actuator_length[i] - shortest) / (longest - shortest)
        found[muscle.name] = (low, low + share * (high - low), high)
    return found


def main(path: Path) -> None:
    """Write the picture."""
    model = build_myoleg26(MyoLeg26Settings(name="myoleg26"), PhysicsConfig())
    figure, panels = plt.subplots(1, len(AXES) + 1, figsize=(20, 4.2), constrained_layout=True)
    for panel, joint in zip(panels, AXES, strict=False):
        low, high = model.joint(f"{joint}_r").range
        angles = np.linspace(low + 1e-3, high - 1e-3, 61)
        entries = [entry for entry in PUBLISHED if entry.joint == joint]
        for colour, entry in zip(plt.get_cmap("tab10").colors, entries, strict=False):
            arms = 1e3 * moment_arms(model, entry.muscle, joint, angles)
            panel.plot(np.rad2deg(angles), arms, color=colour, label=entry.muscle)
            corner = (entry.angles[0], 1e3 * entry.least)
            size = (entry.angles[1] - entry.angles[0], 1e3 * (entry.most - entry.least))
            panel.add_patch(Rectangle(corner, *size, color=colour, alpha=0.12, linewidth=0))
        panel.axhline(0.0, color="black", linewidth=0.5)
        panel.set(title=joint.replace("_", " "), xlabel="angle [°]", ylabel="moment arm [mm]")
        panel.legend(frameon=False, fontsize=8)
    panel = panels[-1]
    for row, (_name, (low, standing, high)) in enumerate(fibre_spans(model).items()):
        panel.plot([low, high], [row, row], color="tab:red", linewidth=4)
        panel.plot(standing, row, "k|", markersize=10)
    panel.axvspan(*WINDOW, color="tab:green", alpha=0.12)
    panel.set(title="fibres over all joint ranges", xlabel="length [optimal lengths], | standing", xlim=(0, 2))
    panel.set_yticks(range(len(MUSCLES)), [muscle.name for muscle in MUSCLES])
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("python docs/examples/moment_arms.py FILE.png")
    main(Path(sys.argv[1]))
