"""Clips on the device: the reference for every frame, and the frames in which episodes begin.

Axes: F frames of all clips, one clip after the other, C clips, J joints, B tracked bodies, S bins of about a second in
all clips, W worlds, N episodes.
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

_NEWEST_WEIGHT = 0.001
"""Weight of the newest env step in the running means of failures and visits."""
_LEAD = 2
"""A start by the failure rate may lie this many bins before the failures, so that the robot gets there by itself."""


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
    """What a library is made from; equal sources give equal libraries."""

    motion: str
    """As in `env.motion`."""
    model: mujoco.MjModel = field(compare=False)
    """The model of the robot."""
    rate: float
    """Frames per second [1/s]."""
    bodies: tuple[str, ...]
    """Names of the B tracked bodies."""
    cut: tuple[float, float] | None
    """As in `env.cut`."""
    mirror: bool
    """As in `env.mirror`."""
    state: tuple[object, ...]
    """What changes a library besides: a digest of the model, and the files with the times of their last change."""

    @classmethod
    def of(cls, settings: G1TrackingSettings, model: mujoco.MjModel, bodies: tuple[str, ...]) -> Self:
        """The source that an environment's settings name."""
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        files = [] if settings.motion.startswith(BUILTIN) else motion_files(settings.motion)
        state = zlib.crc32(buffer.tobytes()), *((str(file.resolve()), file.stat().st_mtime_ns) for file in files)
        rate = 1.0 / settings.control_timestep
        return cls(settings.motion, model, rate, bodies, settings.cut, settings.mirror, state)


@lru_cache(maxsize=1)
def library_of(source: Source) -> Library:
    """The library made from a source. It is kept for the next environment of the trial, such as the evaluator's.

    Raises:
        ConfigError: there are no motions, or one is not of this robot.
    """
    robot_bodies = body_names(source.model)
    tracked = [robot_bodies.index(body) for body in source.bodies]
    clips = []
    for motion in read_motions(source.motion, source.model):
        part = motion.part(source.rate, source.cut)
        for followed in (part, part.mirrored(source.model)) if source.mirror else (part,):
            clips.append(_tables(Clip.of(followed, source.model), tracked))
    names, joints, bodies = zip(*clips, strict=True)
    lengths = tuple(map(len, joints))
    return Library(names, lengths, torch.from_numpy(np.concatenate(joints)), torch.from_numpy(np.concatenate(bodies)))


def _tables(clip: Clip, tracked: list[int]) -> tuple[str, np.ndarray, np.ndarray]:
    """Name of a clip, and its rows of `Library.joints` and `Library.bodies`, float32."""
    joints = np.concatenate((clip.motion.joints, clip.joint_rates), axis=1)
    parts = (clip.position, clip.orientation, clip.velocity, clip.angular_velocity)
    bodies = np.concatenate([part[:, tracked] for part in parts], axis=-1)
    return clip.motion.name, joints.astype(np.float32), bodies.astype(np.float32)


class Reference(NamedTuple):
    """Where the tracked bodies should be and how they should move, in world coordinates."""

    position: Tensor
    """[m], (W, B, 3)."""
    orientation: Tensor
    """Unit quaternions (w, x, y, z), (W, B, 4)."""
    velocity: Tensor
    """[m/s], (W, B, 3)."""
    angular_velocity: Tensor
    """[rad/s], (W, B, 3)."""


class References:
    """The clips of a library on a device.

    Args:
        library: the clips.
        anchor: number of the anchor among the tracked bodies.
        device: where the tables are.

    Attributes:
        names, lengths: as in the library.
        firsts, lasts: numbers of the first and last frame of each clip, (C,) int64.
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
        """Joint angles [rad], then rates [rad/s], in frames (W,), (W, 2 J)."""
        return self._joints.index_select(0, frame)

    def anchor(self, frame: Tensor) -> Tensor:
        """Position [m] and orientation of the anchor in frames (W,), (W, 7)."""
        return self._anchor.index_select(0, frame)

    def bodies(self, frame: Tensor) -> Reference:
        """The tracked bodies in frames (W,)."""
        return Reference(*self._bodies.index_select(0, frame).unflatten(1, (-1, 13)).split((3, 4, 3, 3), dim=-1))


class StartFrames:
    """Draws the frames in which episodes begin.

    Clips are divided into bins of about a second. A draw by the failure rate prefers bins in which many of the episodes
    that got there have failed, and the two bins before. Failures and visits are averaged in tensors that are changed in
    place, so that epochs recorded as CUDA graphs count too.

    Args:
        references: the clips.
        rate: frames per second [1/s].
        sampling: how to draw.

    Attributes:
        failures: running mean of the failures in each bin per env step, (S,).
        visits: running mean of the number of worlds in each bin, (S,).
    """

    def __init__(self, references: References, rate: float, sampling: Sampling) -> None:
        device = references.firsts.device
        self._sampling = sampling
        self._references = references
        counts = [math.floor(length / rate) + 1 for length in references.lengths]
        clip = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
        bins_of_clip = torch.tensor(counts)[clip]
        place_in_clip = torch.cat([torch.arange(count) for count in counts])
        length = torch.tensor(references.lengths)[clip]
        self._clip = clip.to(device)
        self._width = ((length - 1) / bins_of_clip).float().to(device)
        self._begin = (place_in_clip * (length - 1) / bins_of_clip).float().to(device)
        first_bins = np.cumsum([0, *counts[:-1]])
        bins_of_frames = [
            first + np.arange(length) * count // length
            for first, count, length in zip(first_bins, counts, references.lengths, strict=True)
        ]
        self._bin_of_frame = torch.from_numpy(np.concatenate(bins_of_frames)).to(device)
        self._share = (self._width / self._width.sum()).to(device)
        left_in_clip = bins_of_clip - 1 - place_in_clip
        ahead = torch.minimum(torch.arange(_LEAD + 1), left_in_clip[:, None])
        self._bins_ahead = (torch.arange(len(clip))[:, None] + ahead).to(device)
        self.failures = torch.zeros(len(clip), device=device)
        self.visits = torch.zeros(len(clip), device=device)

    def chances(self) -> Tensor:
        """The probability that an episode begins in each bin, (S,)."""
        if self._sampling == "uniform":
            return self._share
        rates = self._share * self.failure_rates()[self._bins_ahead].mean(1)
        return rates / rates.sum()

    def failure_rates(self) -> Tensor:
        """Failures per env step of a world in each bin, (S,), as if all bins had been visited once more: each as often
        as they are in the mean, and failing as often as they do in the mean. All 1 before the first failure."""
        mean = self.failures.sum() / self.visits.sum().clamp_min(1e-12)
        usual = self.visits.mean()
        rates = (self.failures + usual * mean) / (self.visits + usual).clamp_min(1e-12)
        return torch.where(mean > 0.0, rates, torch.ones_like(rates))

    def draw(self, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """First frames of N episodes and last frames of their clips, each (N,) int64.

        Args:
            uniform: random numbers in [0, 1), (N, 2).
        """
        if self._sampling == "start":
            raise AssertionError("episodes that begin with a clip are not drawn")
        chances = self.chances().cumsum(0)
        drawn_bin = torch.searchsorted(chances / chances[-1], uniform[:, 0].contiguous(), right=True)
        drawn_bin = drawn_bin.clamp_max(len(chances) - 1)
        clip = self._clip[drawn_bin]
        within = (self._begin[drawn_bin] + self._width[drawn_bin] * uniform[:, 1]).long()
        return self._references.firsts[clip] + within, self._references.lasts[clip]

    @torch.no_grad()
    def tally(self, frame: Tensor, failed: Tensor) -> Tensor:
        """Failures and visits in each bin, (2, S), of worlds in frames (W,) that have `failed` or not, (W,) bool."""
        worlds = torch.stack((failed.float(), torch.ones_like(failed, dtype=torch.float32)))
        return worlds.new_zeros((2, len(self.failures))).index_add_(1, self._bin_of_frame[frame], worlds)

    @torch.no_grad()
    def count(self, tally: Tensor) -> None:
        """Add the failures and visits of an env step, (2, S), to the running means."""
        failures, visits = tally
        self.failures.lerp_(failures, _NEWEST_WEIGHT)
        self.visits.lerp_(visits, _NEWEST_WEIGHT)
