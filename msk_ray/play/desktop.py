"""MuJoCo's own window on the desktop."""

import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import glfw
import mujoco
import mujoco.viewer
from torch import Tensor

from msk_ray.errors import DeviceError
from msk_ray.play import NO_DISPLAY
from msk_ray.play.screen import Screen
from msk_ray.step import StepState
from msk_ray.visualize.look import default_camera


class Desktop(Screen):
    """MuJoCo's passive viewer.

    Args:
        groups: of geoms to draw at first.
    """

    def __init__(self, model: mujoco.MjModel, groups: Sequence[int]) -> None:
        super().__init__(model)
        self._viewer = mujoco.viewer.launch_passive(self.model, self.data, show_left_ui=False, show_right_ui=False)
        with self._viewer.lock():
            self.look.switch_on(self._viewer.opt, groups)
            camera = default_camera(self.model)
            for field in ("type", "fixedcamid", "trackbodyid", "distance", "azimuth", "elevation", "lookat"):
                setattr(self._viewer.cam, field, getattr(camera, field))

    def is_open(self) -> bool:
        """Whether the window is."""
        return bool(self._viewer.is_running())

    def show(self, state: StepState, control: Tensor) -> None:
        with self._viewer.lock():
            self._take(state, control)
        self._viewer.sync()

    def close(self) -> None:
        """Close the window."""
        self._viewer.close()


@contextmanager
def desktop(model: mujoco.MjModel, groups: Sequence[int]) -> Iterator[Desktop]:
    """A window, whose thread has ended when the block is left. Says how to end it.

    Raises:
        DeviceError: no window can be opened; MuJoCo's viewer would end the process.
    """
    _check_display()
    before = set(threading.enumerate())
    screen = Desktop(model, groups)
    print("close the window to end", flush=True)
    try:
        yield screen
    finally:
        screen.close()
        # The interpreter must not exit while a thread is still closing OpenGL.
        for thread in set(threading.enumerate()) - before:
            thread.join(timeout=10.0)


def _check_display() -> None:
    if sys.platform != "linux":  # elsewhere a display is there, and mjpython has begun GLFW
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", glfw.GLFWError)
        opens = glfw.init()
    if not opens:
        raise DeviceError(NO_DISPLAY)
    glfw.terminate()  # the viewer begins and ends GLFW itself
