"""Motions of a robot: reads, resamples, cuts and mirrors them, and computes how each body moves.

Velocities are finite differences, as in mjlab's `csv_to_npz`; poses of bodies come from the simulation's kinematics.

Axes: F frames, J joints except the free one, B bodies of the robot.
"""

import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import mujoco
import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from msk_ray.errors import ConfigError, brief
from msk_ray.step.adjoint.forward_kinematics import FrameWalk
from msk_ray.step.autograd.tangent import quat_conjugate, quat_exp, quat_log, quat_multiply, quat_rotate

Array = NDArray[np.float64]

CSV_RATE: Final = 30.0
"""Frames per second of CSV files, which do not say it [1/s]."""
BUILTIN: Final = "builtin:"
SUFFIXES: Final = (".csv", ".npz")
_MAX_BYTES: Final = 2**28
"""Largest file that is read, packed or unpacked [B]."""
_MIN_FRAMES: Final = 3
_NORM_TOLERANCE: Final = 0.01
"""Largest deviation of a quaternion's norm from 1 that is not refused."""
_WRONG_ORDER: Final = 0.5
"""Angle beyond a joint's range [rad] that, in a tenth of the frames, means that joints are in another order."""
_BATCH: Final = 4096
"""Frames whose bodies are placed at once."""


@dataclass(frozen=True)
class Motion:
    """Poses of a robot at a constant frame rate."""

    name: str
    rate: float
    """Frames per second [1/s]."""
    position: Array
    """Position of the base [m], (F, 3)."""
    orientation: Array
    """Orientation of the base, unit quaternions (w, x, y, z), (F, 4)."""
    joints: Array
    """Joint angles [rad], (F, J)."""

    def __len__(self) -> int:
        return len(self.position)

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last [s]."""
        return (len(self) - 1) / self.rate

    @property
    def qpos(self) -> Array:
        """MuJoCo's `qpos`, (F, 7 + J)."""
        return np.concatenate((self.position, self.orientation, self.joints), axis=1)

    def at_rate(self, rate: float) -> "Motion":
        """The motion at another frame rate [1/s], with positions and angles interpolated linearly and orientations
        spherically. As in mjlab, a motion that is resampled loses its last frame."""
        if math.isclose(rate, self.rate):
            return self
        times = np.arange(0.0, self.seconds, 1.0 / rate)
        place = times * self.rate
        before = np.minimum(place.astype(int), len(self) - 2)
        share = (place - before)[:, None]

        def interpolated(values: Array) -> Array:
            return (1.0 - share) * values[before] + share * values[before + 1]

        orientation = slerp(self.orientation[before], self.orientation[before + 1], share)
        return Motion(self.name, rate, interpolated(self.position), orientation, interpolated(self.joints))

    def cut(self, start: float, end: float) -> "Motion":
        """The part between two times [s].

        Raises:
            ConfigError: it has fewer than 3 frames.
        """
        first, last = math.ceil(start * self.rate - 1e-6), math.floor(end * self.rate + 1e-6)
        part = slice(first, last + 1)
        if len(self.position[part]) < _MIN_FRAMES:
            raise ConfigError(
                f"env.cut: {self.name} is {self.seconds:.2f} s long, and {start:g} to {end:g} s has fewer than "
                f"{_MIN_FRAMES} frames of it"
            )
        return replace(self, position=self.position[part], orientation=self.orientation[part], joints=self.joints[part])

    def part(self, rate: float, cut: tuple[float, float] | None) -> "Motion":
        """The motion at a frame rate [1/s], from one time to another [s]; None: all of it.

        Raises:
            ConfigError: as for `cut`.
        """
        whole = self.at_rate(rate)
        return whole if cut is None else whole.cut(*cut)

    def mirrored(self, model: mujoco.MjModel) -> "Motion":
        """The motion with left and right exchanged."""
        names = [model.joint(joint).name for joint in range(1, model.njnt)]
        partner = [names.index(_other_side(name)) for name in names]
        # The y axis is normal to the mirror: turns about it keep their sign, turns about other axes change it.
        signs = np.where(np.abs(model.jnt_axis[1:, 1]) > 0.5, 1.0, -1.0)
        return replace(
            self,
            name=f"{self.name} mirrored",
            position=self.position * (1.0, -1.0, 1.0),
            orientation=self.orientation * (1.0, -1.0, 1.0, -1.0),
            joints=self.joints[:, partner] * signs,
        )


@dataclass(frozen=True)
class Clip:
    """A motion with its joint rates, and with poses and velocities of the robot's bodies in world coordinates."""

    motion: Motion
    joint_rates: Array
    """[rad/s], (F, J)."""
    position: Array
    """Positions of the bodies' origins [m], (F, B, 3)."""
    orientation: Array
    """Orientations of the bodies, unit quaternions (w, x, y, z), (F, B, 4)."""
    velocity: Array
    """Velocities of the bodies' origins [m/s], (F, B, 3)."""
    angular_velocity: Array
    """Angular velocities of the bodies [rad/s], (F, B, 3)."""

    @classmethod
    def of(cls, motion: Motion, model: mujoco.MjModel) -> "Clip":
        """The clip of a motion of this model's robot."""
        step = 1.0 / motion.rate
        rates, linear = np.gradient(motion.joints, step, axis=0), np.gradient(motion.position, step, axis=0)
        angular = _angular_velocity(motion.orientation, step)
        qvel = np.concatenate((linear, _into_axes(motion.orientation, angular), rates), axis=1)
        return cls(motion, rates, *_body_states(model, motion.qpos, qvel))

    def save(self, path: Path) -> None:
        """Write the file that mjlab's `csv_to_npz` writes."""
        np.savez_compressed(
            path,
            fps=np.array([self.motion.rate]),
            joint_pos=self.motion.joints.astype(np.float32),
            joint_vel=self.joint_rates.astype(np.float32),
            body_pos_w=self.position.astype(np.float32),
            body_quat_w=self.orientation.astype(np.float32),
            body_lin_vel_w=self.velocity.astype(np.float32),
            body_ang_vel_w=self.angular_velocity.astype(np.float32),
        )


def motion_files(where: str) -> list[Path]:
    """The motion file at a path, or the motion files in the folder there, sorted by name.

    Raises:
        ConfigError: there are none.
    """
    path = Path(where).expanduser()
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix in SUFFIXES and file.is_file())
        if not files:
            raise ConfigError(f"{path}: no motions in this folder: they are files *.csv or *.npz")
        return files
    if not path.is_file():
        known = ", ".join(f"{BUILTIN}{name}" for name in BUILTIN_MOTIONS)
        place = "" if path.is_absolute() else f" in {Path.cwd()}"
        raise ConfigError(f"no motion {brief(where)}{place}: write a file .csv or .npz, a folder of them, or {known}")
    return [path]


def read_motions(where: str, model: mujoco.MjModel) -> list[Motion]:
    """The motions in a file or folder, or the built-in one of a name such as `builtin:squat`, at their own frame rates.

    Raises:
        ConfigError: there are none, or one is not a motion of this robot.
    """
    if where.startswith(BUILTIN):
        make = BUILTIN_MOTIONS.get(where.removeprefix(BUILTIN))
        if make is None:
            known = ", ".join(f"{BUILTIN}{name}" for name in BUILTIN_MOTIONS)
            raise ConfigError(f"no motion {brief(where)}: the built-in ones are {known}")
        return [make(model)]
    return [read_motion(path, model) for path in motion_files(where)]


def read_motion(path: Path, model: mujoco.MjModel) -> Motion:
    """The motion in a file.

    A CSV file has one frame a line, as in Unitree's retargeted LAFAN1: position of the base, quaternion x, y, z, w, and
    joint angles in the order of the model. An NPZ file is written by mjlab's `csv_to_npz`.

    Raises:
        ConfigError: the file holds no motion of this robot.
    """
    read = {".csv": _read_csv, ".npz": _read_npz}.get(path.suffix)
    if read is None:
        raise ConfigError(f"{path}: a motion is a file .csv or .npz")
    if path.stat().st_size > _MAX_BYTES:
        raise ConfigError(f"{path}: larger than {_MAX_BYTES // 2**20} MiB, which no motion is")
    rate, qpos = read(path)
    _check_poses(path, qpos, model)
    orientation = qpos[:, 3:7] / np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    motion = Motion(path.stem, rate, qpos[:, :3], orientation, qpos[:, 7:])
    _check_order(path, motion, model)
    return motion


def _check_poses(path: Path, qpos: Array, model: mujoco.MjModel) -> None:
    """Raise ConfigError unless the rows of `qpos` are finite poses of this robot with unit quaternions."""
    joints = model.njnt - 1
    if qpos.ndim != 2 or qpos.shape[1] != 7 + joints:
        columns = qpos.shape[-1] if qpos.ndim == 2 else 0
        raise ConfigError(
            f"{path}: {columns} numbers a frame, not {7 + joints}: 3 of the position, 4 of the orientation and "
            f"{joints} joints, from {model.joint(1).name} to {model.joint(joints).name}"
        )
    if len(qpos) < _MIN_FRAMES:
        raise ConfigError(f"{path}: {len(qpos)} frames; a motion has {_MIN_FRAMES} or more")
    if not np.isfinite(qpos).all():
        raise ConfigError(f"{path}: frame {int(np.flatnonzero(~np.isfinite(qpos).all(1))[0])} is not finite")
    norm = np.linalg.norm(qpos[:, 3:7], axis=1)
    if (np.abs(norm - 1.0) > _NORM_TOLERANCE).any():
        frame = int(np.abs(norm - 1.0).argmax())
        raise ConfigError(f"{path}: columns 4 to 7 of frame {frame} are no unit quaternion (length {norm[frame]:.3g})")


def _read_csv(path: Path) -> tuple[float, Array]:
    """Frame rate [1/s] and rows of a CSV file in the order of `qpos`."""
    try:
        rows = np.loadtxt(path, delimiter=",", ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not a table of numbers: {' '.join(str(error).split())}") from None
    if rows.shape[1] >= 7:
        rows[:, 3:7] = rows[:, [6, 3, 4, 5]]
    return CSV_RATE, rows


def _read_npz(path: Path) -> tuple[float, Array]:
    """Frame rate [1/s] and `qpos` of a file of mjlab's `csv_to_npz`."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > _MAX_BYTES:
                raise ConfigError(f"{path}: its content is larger than {_MAX_BYTES // 2**20} MiB, which no motion is")
        with np.load(path, allow_pickle=False) as arrays:
            rate = float(np.ravel(arrays["fps"])[0])
            base = [np.asarray(arrays[name], np.float64)[:, 0] for name in ("body_pos_w", "body_quat_w")]
            joints = np.asarray(arrays["joint_pos"], np.float64)
            qpos = np.concatenate((*base, joints), axis=1)
    except KeyError as error:
        raise ConfigError(f"{path}: {error.args[0]}: write the file with mjlab's csv_to_npz") from None
    except (ValueError, IndexError, OSError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{path}: not a file of mjlab's csv_to_npz: {' '.join(str(error).split())}") from None
    if not 1.0 <= rate <= 1000.0:
        raise ConfigError(f"{path}: {rate:g} frames per second; 1 to 1000 are possible")
    return rate, qpos


def _check_order(path: Path, motion: Motion, model: mujoco.MjModel) -> None:
    """Raise ConfigError if joints seem to be in another order than the model's."""
    excess = beyond_range(motion, model)
    share_of_frames = (excess > _WRONG_ORDER).mean(0)
    if (share_of_frames > 0.1).any():
        joint = int(share_of_frames.argmax())
        raise ConfigError(
            f"{path}: column {8 + joint} is up to {excess[:, joint].max():.2g} rad beyond the range of "
            f"{model.joint(joint + 1).name}: joints are in the order of the robot's model, from {model.joint(1).name} "
            f"to {model.joint(model.njnt - 1).name}"
        )


def beyond_range(motion: Motion, model: mujoco.MjModel) -> Array:
    """Angles beyond the ranges of the joints [rad], (F, J)."""
    low, high = model.jnt_range[1:].T
    return np.maximum(np.maximum(low - motion.joints, motion.joints - high), 0.0)


def slerp(start: Array, end: Array, share: Array) -> Array:
    """Unit quaternions (F, 4) interpolated spherically along the shorter arc, at shares (F, 1) of it."""
    first = torch.from_numpy(start)
    turn = quat_log(quat_multiply(quat_conjugate(first), torch.from_numpy(end)))
    return _array(quat_multiply(first, quat_exp(torch.from_numpy(share) * turn)))


def _angular_velocity(orientation: Array, step: float) -> Array:
    """Angular velocity in world coordinates [rad/s], (F, 3), by central differences over frames `step` seconds apart;
    the first and last frame have their neighbour's."""
    before, after = torch.from_numpy(orientation[:-2]), torch.from_numpy(orientation[2:])
    spin = _array(quat_log(quat_multiply(after, quat_conjugate(before)))) / (2.0 * step)
    return np.concatenate((spin[:1], spin, spin[-1:]))


def _into_axes(orientation: Array, vector: Array) -> Array:
    """Vectors (F, 3) in the axes of unit quaternions (w, x, y, z), (F, 4)."""
    return _array(quat_rotate(quat_conjugate(torch.from_numpy(orientation)), torch.from_numpy(vector)))


def _array(values: Tensor) -> Array:
    array: Array = values.numpy()
    return array


def _body_states(model: mujoco.MjModel, qpos: Array, qvel: Array) -> tuple[Array, Array, Array, Array]:
    """Positions, orientations, velocities and angular velocities of the robot's bodies, as in `Clip`."""
    walk = FrameWalk(model, _BATCH, wp.get_device())
    rows = [np.zeros((_BATCH, size), dtype=np.float32) for size in (model.nq, model.nv)]
    robot_frames = walk.body_frame[_robot_bodies(model)]
    batches = []
    for first in range(0, len(qpos), _BATCH):
        part = slice(first, first + _BATCH)
        count = len(qpos[part])
        for array, row, values in zip((walk.qpos, walk.qvel), rows, (qpos, qvel), strict=True):
            row[:count] = values[part]
            array.assign(row)
        walk.launch_forward()
        batches.append([array.numpy()[:count, robot_frames].astype(np.float64) for array in walk.frames])
    position, orientation, velocity, angular_velocity = (np.concatenate(parts) for parts in zip(*batches, strict=True))
    return position, np.roll(orientation, 1, axis=-1), velocity, angular_velocity  # Warp has (x, y, z, w)


def _robot_bodies(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Numbers of the bodies that move with the free joint, (B,), in the model's order, which mjlab's files share."""
    return np.flatnonzero(model.body_rootid == model.jnt_bodyid[0])


def body_names(model: mujoco.MjModel) -> list[str]:
    """Names of the robot's bodies, in the order of a clip's axis B."""
    return [model.body(int(body)).name for body in _robot_bodies(model)]


def _other_side(name: str) -> str:
    """The name of the part on the other side of the robot; the same for a part in its middle."""
    if name.startswith("left_"):
        return f"right_{name.removeprefix('left_')}"
    return f"left_{name.removeprefix('right_')}" if name.startswith("right_") else name


def _squat(model: mujoco.MjModel) -> Motion:
    """A squat of 4 s that begins and ends in the default pose: feet stay in place, arms swing and the waist turns."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    standing = data.qpos.copy()
    count = round(4.0 * CSV_RATE) + 1
    phase = 2.0 * math.pi * np.arange(count) / (count - 1)
    down, side = (1.0 - np.cos(phase)) / 2.0, np.sin(phase)
    shifts = {
        **{f"{leg}_hip_pitch_joint": -0.55 * down for leg in ("left", "right")},
        **{f"{leg}_knee_joint": 1.0 * down for leg in ("left", "right")},
        **{f"{leg}_ankle_pitch_joint": -0.45 * down for leg in ("left", "right")},
        "left_shoulder_pitch_joint": -0.8 * down + 0.3 * side,
        "right_shoulder_pitch_joint": -0.8 * down - 0.3 * side,
        "waist_yaw_joint": 0.3 * side,
    }
    qpos = np.tile(standing, (count, 1))
    for joint, shift in shifts.items():
        qpos[:, model.joint(joint).qposadr[0]] += shift
    ankles = [model.body(f"{leg}_ankle_roll_link").id for leg in ("left", "right")]
    positions = _body_states(model, qpos, np.zeros((count, model.nv)))[0]
    first_body = int(_robot_bodies(model)[0])
    feet = positions[:, [ankle - first_body for ankle in ankles]].mean(1)
    qpos[:, :3] += feet[0] - feet
    return Motion("squat", CSV_RATE, qpos[:, :3], qpos[:, 3:7], qpos[:, 7:])


BUILTIN_MOTIONS: Final[dict[str, Callable[[mujoco.MjModel], Motion]]] = {"squat": _squat}
"""Motions that need no file, by name."""
