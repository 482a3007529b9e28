"""A page in a browser, by mjviser: https://github.com/mujocolab/mjviser."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO

import mujoco
import viser
from mjviser import ViserMujocoScene
from torch import Tensor

from msk_ray.errors import ConfigError
from msk_ray.play.screen import Screen
from msk_ray.step import StepState

HOST = "127.0.0.1"
"""Only this machine can reach the page: whoever can may move the camera for everybody."""


class Browser(Screen):
    """A page that a server in this process keeps up to date.

    Args:
        server: where the page is.
        groups: of geoms to draw at first.
    """

    def __init__(self, model: mujoco.MjModel, groups: Sequence[int], server: viser.ViserServer) -> None:
        super().__init__(model)
        self._scene = ViserMujocoScene(server, self.model, num_envs=1)
        self._scene.geom_groups_visible = [group in groups for group in range(mujoco.mjNGROUP)]
        self._scene.rebuild_visual_handles()
        self._scene.create_visualization_gui(camera_distance=1.5 * model.stat.extent)  # that of MuJoCo's free camera

    def is_open(self) -> bool:
        """Always: the page may be opened later, or again. Ctrl-C ends the command."""
        return True

    def show(self, state: StepState, control: Tensor) -> None:
        self._take(state, control)
        self._scene.update_from_mjdata(self.data)


@contextmanager
def browser(model: mujoco.MjModel, groups: Sequence[int], port: int) -> Iterator[Browser]:
    """A page at a port of this machine, or at any free one for port 0. Says where.

    Raises:
        ConfigError: the port is in use.
    """
    with redirect_stdout(StringIO()):  # a box with two addresses
        server = viser.ViserServer(HOST, port, verbose=False)
    server.gui.configure_theme(
        show_share_button=False
    )  # it would show the page to everybody, through a server of viser
    try:
        if port not in (0, server.get_port()):  # it takes the next free one
            raise ConfigError(f"cannot listen on {HOST} port {port}: it is in use; write another --port, or 0")
        screen = Browser(model, groups, server)
        print(f"http://{HOST}:{server.get_port()}/; Ctrl-C ends it", flush=True)
        yield screen
    finally:
        server.stop()
