"""Strides as stick figures from the side, a policy's beside people's on the same legs.

Axes: T samples of a stride, P points of a figure.
"""

from collections.abc import Iterator
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from numpy.typing import NDArray

from msk_ray.errors import ConfigError
from msk_ray.legs.gait.body import SIDES, Episode, world_axes
from msk_ray.legs.gait.cycles import strides
from msk_ray.legs.gait.measure import contacts, settled
from msk_ray.visualize.film import write_video

Array = NDArray[np.float64]

LEG = ("femur", "tibia", "talus", "calcn", "toes")
"""Bodies whose origins are hip, knee, ankle, heel and the joint of the toes."""
_TRUNK = 0.5
"""Length of the line that stands for the trunk [m]."""
_COLOURS = {"r": "tab:red", "l": "tab:blue"}
_FRAMES = 30
"""Frames of a stride."""


def figures(model: mujoco.MjModel, qpos: Array) -> Array:
    """Points of a stick figure (T, 3, 5, 2) of the right leg, the left leg and the trunk, whose last four are the same:
    forward of the pelvis and above the lowest point of the stride [m]."""
    axes = world_axes(model)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    mujoco.mj_kinematics(model, data)
    upright = data.body("pelvis").xmat.reshape(3, 3).T @ axes[2]
    points = np.zeros((len(qpos), 3, len(LEG), 3))
    for t, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        for row, side in enumerate(SIDES):
            points[t, row] = [data.body(f"{name}_{side}").xpos for name in LEG]
        pelvis = data.body("pelvis")
        points[t, 2] = points[t, :2, 0].mean(0)
        points[t, 2, 1:] += _TRUNK * pelvis.xmat.reshape(3, 3) @ upright
        points[t] -= pelvis.xpos @ axes[0] * axes[0]
    flat = points @ axes[[0, 2]].T
    flat[..., 1] -= flat[..., 1].min()
    return flat


def one_stride(episodes: list[Episode], qpos: list[Array]) -> tuple[Array, float]:
    """qpos (T, nq) of the middle stride of the right foot in the longest episode, and its duration [s].

    Args:
        episodes: time series.
        qpos: of each episode, at the same samples.

    Raises:
        ConfigError: there is none.
    """
    longest = max(range(len(episodes)), key=lambda k: len(episodes[k].forward))
    episode = episodes[longest]
    start = settled(episode)
    found = strides(contacts(episode, "r"))
    if not found:
        raise ConfigError("--film: the policy takes no stride to draw; leave it out")
    middle = found[len(found) // 2]
    return qpos[longest][start + middle.start : start + middle.end], middle.samples * episode.timestep


def film(own: Array, people: Array, seconds: float, path: Path) -> int:
    """Draw one stride of a policy, `figures` (T, 3, 5, 2), beside people's, each from the right foot's strike on.

    Args:
        own: the policy's.
        people: people's, of any number of samples.
        seconds: duration of the policy's stride [s].
        path: as for `visualize --video`.

    Returns:
        How many frames.
    """
    return write_video(_frames(own, people), path, _FRAMES / seconds)


def _frames(own: Array, people: Array) -> Iterator[NDArray[np.uint8]]:
    figure, axes = plt.subplots(1, 2, figsize=(8, 5), dpi=80, constrained_layout=True)
    for phase in np.arange(_FRAMES) / _FRAMES:
        for axis, points, title in zip(axes, (own, people), ("policy", "people, on the same legs"), strict=True):
            now = points[int(phase * len(points))]
            axis.clear()
            axis.plot(*now[2, :2].T, color="0.4", linewidth=6, solid_capstyle="round")
            for row, (side, colour) in enumerate(_COLOURS.items()):
                label = "right" if side == "r" else "left"
                axis.plot(*now[row].T, color=colour, linewidth=4, solid_capstyle="round", marker="o", label=label)
            axis.axhline(0.0, color="0.7", linewidth=1)
            axis.set(xlim=(-0.8, 0.8), ylim=(-0.05, 1.55), aspect="equal", title=f"{title}: {phase:.0%} of the cycle")
            axis.set_xticks([])
            axis.set_yticks([])
        axes[0].legend(loc="upper left", frameon=False)
        figure.canvas.draw()
        yield np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
    plt.close(figure)
