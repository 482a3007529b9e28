"""Clips on the device: what the robot is to do in every frame, and in which frames episodes begin.

Axes: F frames of all clips, one after the other, C clips, J joints, B tracked bodies, S seconds ("bins") of all clips,
W worlds, N episodes.
"""

import math
import zlib
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple, Self

import mujoco
import numpy as np
import torch
from torch import Tensor

from msk_ray.robots.tracking.config import G1TrackingSettings, Sampling
from msk_ray.robots.tracking.motions import BUILTIN, Clip, body_names, motion_files, read_motions

_ANYWHERE = 0.1
"""Share of adaptive starts that are drawn anywhere. mjlab adds 0.1 to the failures of all worlds in a step instead, so
that its share depends on their number."""
_NEWEST = 0.001
"""Share of the newest env step in the mean of failures."""


class Library(NamedTuple):
    """Clips as float32 tables on the host."""

    names: tuple[str, ...]
    lengths: tuple[int, ...]
    """Frames of each clip; they sum to F."""
    joints: Tensor
    """Angles [rad], then rates [rad/s], (F, 2 J)."""
    bodies: Tensor
    """Position, orientation, velocity and angular velocity of each tracked body, (F, B, 13)."""


@dataclass(frozen=True)
class Source:
    """What a library is made of."""

    motion: str
    """As `env.motion`."""
    model: mujoco.MjModel = field(compare=False)
    """The robot's."""
    rate: float
    """Frames per second."""
    bodies: tuple[str, ...]
    """The tracked ones, B of them."""
    cut: tuple[float, float] | None
    mirror: bool
    state: tuple[object, ...]
    """What else changes a library: files with the times of their last change, and a digest of the model."""

    @classmethod
    def of(cls, settings: G1TrackingSettings, model: mujoco.MjModel, bodies: tuple[str, ...]) -> Self:
        """That of an environment's settings."""
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        files = [] if settings.motion.startswith(BUILTIN) else motion_files(settings.motion)
        state = zlib.crc32(buffer.tobytes()), *((str(file.resolve()), file.stat().st_mtime_ns) for file in files)
        rate = 1.0 / settings.control_timestep
        return cls(settings.motion, model, rate, bodies, settings.cut, settings.mirror, state)


@lru_cache(maxsize=1)
def library_of(source: Source) -> Library:
    """The library; kept for the next environment of a trial, such as that of its evaluations.

    Raises:
        ConfigError: there are no motions, or one is not of this robot.
    """
    known = body_names(source.model)
    tracked = [known.index(body) for body in source.bodies]
    clips = []
    for motion in read_motions(source.motion, source.model):
        whole = motion.at_rate(source.rate)
        part = whole if source.cut is None else whole.cut(*source.cut)
        for each in (part, part.mirrored(source.model)) if source.mirror else (part,):
            clips.append(_tables(Clip.of(each, source.model), tracked))
    names, joints, frames = zip(*clips, strict=True)
    lengths = tuple(map(len, joints))
    return Library(names, lengths, torch.from_numpy(np.concatenate(joints)), torch.from_numpy(np.concatenate(frames)))


def _tables(clip: Clip, tracked: list[int]) -> tuple[str, np.ndarray, np.ndarray]:
    joints = np.concatenate((clip.motion.joints, clip.joint_rates), axis=1)
    parts = (clip.position, clip.orientation, clip.velocity, clip.angular_velocity)
    frames = np.concatenate([part[:, tracked] for part in parts], axis=-1)
    return clip.motion.name, joints.astype(np.float32), frames.astype(np.float32)


class Reference(NamedTuple):
    """What tracked bodies are to do, (W, B, ·), in world coordinates."""

    position: Tensor
    orientation: Tensor
    velocity: Tensor
    angular_velocity: Tensor


class References:
    """The clips of a library on a device.

    Args:
        library: the clips.
        anchor: number of the anchor among the tracked bodies.
        device: where they are.

    Attributes:
        names, lengths: of the clips.
        firsts, lasts: numbers of their first and last frames, (C,) int64.
    """

    def __init__(self, library: Library, anchor: int, device: torch.device) -> None:
        self.names, self.lengths = library.names, library.lengths
        lengths = torch.tensor(library.lengths)
        self.firsts = (lengths.cumsum(0) - lengths).to(device)
        self.lasts = (lengths.cumsum(0) - 1).to(device)
        self._joints = library.joints.to(device)
        self._bodies = library.bodies.flatten(1).to(device)
        self._anchor = library.bodies[:, anchor, :7].contiguous().to(device)

    def joints(self, frame: Tensor) -> Tensor:
        """Angles, then rates of the joints in frames (W,), (W, 2 J)."""
        return self._joints.index_select(0, frame)

    def anchor(self, frame: Tensor) -> Tensor:
        """Position and orientation of the anchor in frames (W,), (W, 7)."""
        return self._anchor.index_select(0, frame)

    def bodies(self, frame: Tensor) -> Reference:
        """Tracked bodies in frames (W,)."""
        return Reference(*self._bodies.index_select(0, frame).unflatten(1, (-1, 13)).split((3, 4, 3, 3), dim=-1))


class StartFrames:
    """Draws the frames in which episodes begin.

    Clips are cut into seconds. An adaptive draw prefers those in which episodes have failed: mean failures per env step
    are kept in a tensor that is changed in place, so that recorded epochs count too.

    Args:
        references: the clips.
        rate: frames per second [1/s].
        sampling: how to draw.

    Attributes:
        failures: in each second, per env step, (S,).
    """

    def __init__(self, references: References, rate: float, sampling: Sampling) -> None:
        device = references.firsts.device
        self._sampling = sampling
        self._references = references
        counts = [math.floor(length / rate) + 1 for length in references.lengths]
        clip = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
        of_clip = torch.tensor(counts)[clip]
        number = torch.cat([torch.arange(count) for count in counts])
        length = torch.tensor(references.lengths)[clip]
        self._clip = clip.to(device)
        self._width = ((length - 1) / of_clip).float().to(device)
        self._begin = (number * (length - 1) / of_clip).float().to(device)
        firsts = np.cumsum([0, *counts[:-1]])
        frames = [
            first + np.arange(length) * count // length
            for first, count, length in zip(firsts, counts, references.lengths, strict=True)
        ]
        self._bin_of = torch.from_numpy(np.concatenate(frames)).to(device)
        self._share = (self._width / self._width.sum()).to(device)
        self.failures = torch.zeros(len(clip), device=device)

    def chances(self) -> Tensor:
        """The chance of each second, (S,)."""
        if self._sampling != "adaptive":
            return self._share
        total = self.failures.sum()
        preferred = _ANYWHERE * self._share + (1.0 - _ANYWHERE) * self.failures / total.clamp_min(1e-12)
        return torch.where(total > 0.0, preferred, self._share)

    def draw(self, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """First and last frames of episodes, each (N,) int64, from uniform numbers in [0, 1), (N, 2)."""
        if self._sampling == "start":
            raise AssertionError("episodes that begin with a clip are not drawn")
        chances = self.chances().cumsum(0)
        second = torch.searchsorted(chances / chances[-1], uniform[:, 0].contiguous(), right=True)
        second = second.clamp_max(len(chances) - 1)
        clip = self._clip[second]
        within = (self._begin[second] + self._width[second] * uniform[:, 1]).long()
        return self._references.firsts[clip] + within, self._references.lasts[clip]

    @torch.no_grad()
    def failed_in(self, frame: Tensor, failed: Tensor) -> Tensor:
        """How many worlds have failed in each second, (S,), in frames (W,), by (W,) bool."""
        return torch.zeros_like(self.failures).index_add_(0, self._bin_of[frame], failed.float())

    @torch.no_grad()
    def count(self, failed: Tensor) -> None:
        """Add an env step's failures (S,) to the mean."""
        self.failures.lerp_(failed, _NEWEST)
