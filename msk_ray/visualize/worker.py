"""The drawing process: reads states from a file and writes raw frames to its standard output.

It is a separate process because a broken OpenGL library crashes the process that tries it, and because MuJoCo chooses
its OpenGL platform when it is first imported.

    MUJOCO_GL=egl python -m msk_ray.visualize.worker --probe
    MUJOCO_GL=egl python -m msk_ray.visualize.worker MODEL.mjb STATES.npz WIDTH HEIGHT GROUPS [CAMERA]
"""

import os
import sys
from collections.abc import Sequence
from typing import BinaryIO

import mujoco
import numpy as np

from msk_ray.visualize.look import Look, add_background, default_camera, has_sky

PROBE = """<mujoco><worldbody><light pos="0 0 3"/><geom type="box" size="1 1 1" rgba="1 0 0 1"/></worldbody></mujoco>"""


def probe() -> int:
    """Draw a box; 0 if it is visible."""
    model = mujoco.MjModel.from_xml_string(PROBE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 32, 32) as renderer:
        renderer.update_scene(data)
        return 0 if int(np.ptp(renderer.render())) > 0 else 1


def draw(
    model: mujoco.MjModel,
    states: dict[str, np.ndarray],
    width: int,
    height: int,
    groups: Sequence[int],
    camera: str,
    out: BinaryIO,
) -> None:
    """Write a frame (height, width, 3) of bytes for each state.

    Args:
        states: `qpos` (F, nq), `qvel` (F, nv), `act` (F, na), `ctrl` (F, nu); `reference`, the positions of a second,
            pale body, (F, nq), or (0, nq) if there is none.
        groups: of geoms to draw.
        camera: name; empty for the default one.
    """
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    data, second = mujoco.MjData(model), mujoco.MjData(model)
    states = dict(states)
    references = states.pop("reference")
    look = Look(model)
    option = mujoco.MjvOption()
    look.switch_on(option, groups)
    view: str | mujoco.MjvCamera = camera or default_camera(model)
    sky, far = has_sky(model), float(model.vis.map.zfar * model.stat.extent)
    with mujoco.Renderer(model, height, width) as renderer:
        for number in range(len(states["qpos"])):
            for field, values in states.items():
                getattr(data, field)[:] = values[number]
            # Contact forces must belong to the state that is drawn, so they are recomputed here.
            mujoco.mj_forward(model, data)
            look.colour(data.act)
            renderer.update_scene(data, view, option)
            if len(references):
                second.qpos[:] = references[number]
                mujoco.mj_kinematics(model, second)
                look.add_reference(renderer.scene, second, option)
            frame = renderer.render()
            if not sky:
                # Drawn again as depth, which tells where nothing was drawn: there goes the sky.
                renderer.enable_depth_rendering()
                frame = add_background(frame, renderer.render(), far)
                renderer.disable_depth_rendering()
            out.write(frame.tobytes())
            out.flush()


def main() -> int:
    """Entry point; returns the exit code."""
    # Only frames go to standard output: what libraries print there is redirected to standard error.
    frames = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    if sys.argv[1:] == ["--probe"]:
        return probe()
    path, states, width, height, groups, *camera = sys.argv[1:]
    with np.load(states) as arrays:
        draw(
            mujoco.MjModel.from_binary_path(path),
            {name: arrays[name] for name in arrays.files},
            int(width),
            int(height),
            [int(group) for group in groups],
            camera[0] if camera else "",
            frames,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
