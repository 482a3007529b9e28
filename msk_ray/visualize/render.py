"""Draw frames of a trajectory in a separate process, on an OpenGL platform that works here."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from msk_ray.errors import DeviceError
from msk_ray.registry import python_path
from msk_ray.visualize.look import geom_groups

BACKENDS = ("egl", "osmesa")
"""Headless OpenGL platforms, the faster one first."""
_PROBE_S = 120.0
ADVICE = "on Debian or Ubuntu: apt install libegl1 (GPU or Mesa), or apt install libosmesa6 (software)"


@dataclass(frozen=True)
class States:
    """F states of one world of one model."""

    model: mujoco.MjModel
    qpos: np.ndarray
    """Shape (F, nq)."""
    qvel: np.ndarray
    """Shape (F, nv)."""
    act: np.ndarray
    """Shape (F, na)."""
    ctrl: np.ndarray
    """Shape (F, nu)."""
    reference: np.ndarray | None = None
    """Positions of a second body, drawn pale beside the first, shape (F, nq); None: there is none."""

    def __len__(self) -> int:
        return len(self.qpos)

    def at(self, indices: np.ndarray) -> "States":
        """The states at some indices."""
        reference = None if self.reference is None else self.reference[indices]
        return States(
            self.model, self.qpos[indices], self.qvel[indices], self.act[indices], self.ctrl[indices], reference
        )


@dataclass(frozen=True)
class View:
    """What a frame shows."""

    width: int = 640
    height: int = 480
    camera: str = ""
    """Name of one of the model's cameras; empty: the first, or one that follows the body."""
    groups: tuple[int, ...] | None = None
    """Groups of geoms to draw; None: as `geom_groups` says."""


@cache
def headless_backend() -> str:
    """The OpenGL platform that works here without a display: `egl`, `osmesa`, or the one in MUJOCO_GL.

    Raises:
        DeviceError: none works; the message names the packages to install.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    if sys.platform != "linux":
        return asked
    faults = {}
    for backend in [asked] if asked in BACKENDS else BACKENDS:
        fault = probe(backend)
        if fault is None:
            return backend
        faults[backend] = fault
    tried = "; ".join(f"{name}: {fault}" for name, fault in faults.items())
    raise DeviceError(f"no OpenGL platform works without a display ({tried}); {ADVICE}")


def probe(backend: str) -> str | None:
    """Why an OpenGL platform does not work, on one line; None if it does."""
    try:
        done = subprocess.run(
            [sys.executable, "-m", "msk_ray.visualize.worker", "--probe"],
            env=_environment(backend),
            capture_output=True,
            text=True,
            timeout=_PROBE_S,
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {_PROBE_S:.0f} s"
    return None if done.returncode == 0 else _last_line(done.stderr, done.returncode)


def frames(states: States, view: View) -> Iterator[np.ndarray]:
    """A frame (height, width, 3), uint8, for each state, yielded as soon as it is drawn.

    Raises:
        DeviceError: no OpenGL platform works, or the drawing process failed.
    """
    backend = headless_backend()
    check_camera(states.model, view.camera)
    with tempfile.TemporaryDirectory() as scratch, (Path(scratch) / "errors").open("w+b") as errors:
        model, arrays = Path(scratch) / "model.mjb", Path(scratch) / "states.npz"
        mujoco.mj_saveModel(states.model, str(model))
        reference = np.empty((0, states.model.nq)) if states.reference is None else states.reference
        np.savez(arrays, qpos=states.qpos, qvel=states.qvel, act=states.act, ctrl=states.ctrl, reference=reference)
        command = [sys.executable, "-m", "msk_ray.visualize.worker", str(model), str(arrays)]
        groups = "".join(map(str, geom_groups(states.model) if view.groups is None else view.groups))
        process = subprocess.Popen(
            [*command, str(view.width), str(view.height), groups, *([view.camera] if view.camera else [])],
            env=_environment(backend),
            stdout=subprocess.PIPE,
            stderr=errors,
        )
        assert process.stdout is not None
        size = view.width * view.height * 3
        try:
            for number in range(len(states)):
                data = process.stdout.read(size)
                if len(data) < size:
                    code = process.wait()
                    errors.seek(0)
                    why = _last_line(errors.read().decode(errors="replace"), code)
                    raise DeviceError(f"drawing with {backend} failed at frame {number}: {why}")
                yield np.frombuffer(data, np.uint8).reshape(view.height, view.width, 3)
        finally:
            process.stdout.close()
            process.kill()
            process.wait()


def check_camera(model: mujoco.MjModel, camera: str) -> None:
    """Raise DeviceError if a model has no camera of this name; the empty name is the default camera."""
    names = [model.camera(number).name for number in range(model.ncam)]
    if camera and camera not in names:
        raise DeviceError(f"--camera {camera!r}: the model has {', '.join(names) or 'no cameras'}")


def _environment(backend: str) -> dict[str, str]:
    """Environment of the drawing process: the platform, and the path of this package."""
    environment = os.environ | {"PYTHONPATH": python_path()}
    return environment | ({"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend} if backend else {})


def _last_line(errors: str, code: int) -> str:
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    return lines[-1] if lines else f"exit code {code}"
