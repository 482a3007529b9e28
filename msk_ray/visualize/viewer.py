"""The interactive viewer: episodes in real time in MuJoCo's window."""

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import mujoco.viewer
import torch

from msk_ray.errors import DeviceError
from msk_ray.evaluate.measure import Bench, Request
from msk_ray.training import SavedPolicy
from msk_ray.visualize.look import Look, default_camera, geom_groups


def check_display() -> None:
    """Check that a window can be shown.

    Raises:
        DeviceError: there is no display; the message names the options that work without one.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise DeviceError(
            "there is no display: add --video out.mp4, --strip out.png, --save-frames DIR or --no-render (or ssh -X)"
        )


@contextmanager
def window(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[Any]:
    """MuJoCo's passive viewer; its thread has ended when the block is left."""
    before = set(threading.enumerate())
    with mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as viewer:
        yield viewer
    # The interpreter must not exit while a thread is still closing OpenGL.
    for thread in set(threading.enumerate()) - before:
        thread.join(timeout=10.0)


def watch(
    bench: Bench,
    policy: SavedPolicy,
    request: Request,
    episodes: int | None,
    speed: float,
    groups: tuple[int, ...] | None = None,
) -> int:
    """Show episodes until the window is closed, or a given number of them.

    Args:
        episodes: how many; None continues until the window is closed.
        speed: simulated seconds per second.
        groups: of geoms to draw at first; None: as `geom_groups` says.

    Returns:
        How many episodes ended.
    """
    evaluator, _ = bench.evaluator(policy.config, Request(request.physics, 1, request.seeds, request.steps))
    env = evaluator.env
    act = policy.on(env)
    model = env.model
    data = mujoco.MjData(model)
    look = Look(model)
    seed = request.seeds[0] if request.seeds else policy.config.evaluation.seed
    env.generator.manual_seed(seed)
    done = 0
    with window(model, data) as viewer:
        with viewer.lock():
            look.switch_on(viewer.opt, geom_groups(model) if groups is None else groups)
            camera = default_camera(model)
            for field in ("type", "fixedcamid", "trackbodyid", "distance", "azimuth", "elevation", "lookat"):
                setattr(viewer.cam, field, getattr(camera, field))
        while viewer.is_running() and (episodes is None or done < episodes):
            with torch.no_grad():
                env.state = env.reset_state()
            started = time.monotonic()
            for step in range(evaluator.steps):
                if not viewer.is_running():
                    return done
                with torch.no_grad():
                    action = act(env.observation())
                    control = env.control(action)
                    transition = env.step(action, auto_reset=False)
                with viewer.lock():
                    state = env.state.physics
                    for name, values in (("qpos", state.qpos), ("qvel", state.qvel), ("act", state.act)):
                        getattr(data, name)[:] = values[0].cpu().numpy()
                    data.ctrl[:] = control[0].cpu().numpy()
                    mujoco.mj_forward(model, data)
                    look.colour(data.act)
                viewer.sync()
                ahead = started + (step + 1) * policy.config.env.control_timestep / speed - time.monotonic()
                if ahead > 0.0:
                    time.sleep(ahead)
                if bool(transition.terminated[0]):
                    break
            done += 1
    return done
