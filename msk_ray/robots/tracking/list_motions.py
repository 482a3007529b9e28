"""`msk-ray motions`: lists motions, says what is wrong with them, and draws them."""

import copy
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from msk_ray.cli import Parser, positive, run
from msk_ray.errors import ConfigError, DeviceError
from msk_ray.files import make_folder
from msk_ray.text_table import text_table

if TYPE_CHECKING:
    import mujoco

    from msk_ray.robots.tracking.motions import Motion

DESCRIPTION = """\
List motions of Unitree's G1: their duration, number of frames, and what is wrong with them (joints beyond their ranges,
body parts inside the ground or each other, hovering). A file that holds no motion of this robot is refused in one line.

Files are CSV at 30 Hz with one frame a line, as in Unitree's retargeted LAFAN1 (position, quaternion x, y, z, w, 29
joint angles), or NPZ from mjlab's csv_to_npz. Also draws a picture with a row of frames for each motion."""

EXAMPLES = """\
  msk-ray motions builtin:squat
  msk-ray motions g1/                                  # a folder of .csv and .npz
  msk-ray motions g1/dance1_subject2.csv --npz mjlab/  # for mjlab, at 50 Hz
  msk-ray motions g1/ --strip none

exit codes: 0 done, 1 a file was refused, 2 there is no motion."""


def parser() -> Parser:
    """The command line."""
    p = Parser("msk-ray motions", DESCRIPTION, EXAMPLES)
    p.add_argument("where", metavar="FILE|FOLDER|builtin:NAME", help="the motions")
    p.add_argument(
        "--strip",
        default="motions.png",
        metavar="FILE",
        help="picture to draw; none: no picture (default: %(default)s)",
    )
    p.add_argument(
        "--frames", type=positive, default=8, metavar="N", help="frames in a row of it (default: %(default)s)"
    )
    p.add_argument(
        "--npz", type=Path, metavar="DIR", help="also write each motion as mjlab's csv_to_npz does, at 50 Hz"
    )
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)

    from msk_ray.config import PhysicsConfig
    from msk_ray.robots.tracking.config import G1TrackingSettings
    from msk_ray.robots.tracking.env import G1Tracking
    from msk_ray.robots.tracking.motion_remarks import remarks
    from msk_ray.robots.tracking.motions import Clip

    settings = G1TrackingSettings(name="g1_tracking")
    model = G1Tracking.build_model(settings, PhysicsConfig())
    motions, refusals = _read(args.where, model)
    rows = [
        (motion.name, f"{motion.seconds:.1f}", str(len(motion)), f"{motion.rate:g}", "; ".join(remarks(motion, model)))
        for motion in motions
    ]
    print(text_table(("motion", "seconds", "frames", "Hz", "remarks"), rows, shutil.get_terminal_size((160, 24))[0]))
    seconds = sum(motion.seconds for motion in motions)
    print(f"{len(motions)} motions, {seconds:.0f} s ({seconds / 3600.0:.2f} h)")
    for reason in refusals:
        print(f"refused: {reason}")
    if args.npz is not None:
        make_folder(args.npz)
        for motion in motions:
            Clip.of(motion.at_rate(1.0 / settings.control_timestep), model).save(args.npz / f"{motion.name}.npz")
        print(f"written into {args.npz}")
    if args.strip != "none" and motions:
        print(_draw(motions, model, args.frames, Path(args.strip)))
    return 1 if refusals else 0


def _read(where: str, model: "mujoco.MjModel") -> "tuple[list[Motion], list[str]]":
    """The motions in a file or folder, or the built-in one, and why other files were refused.

    Raises:
        ConfigError: there are neither motions nor files.
    """
    from msk_ray.robots.tracking.motions import BUILTIN, motion_files, read_motion, read_motions

    if where.startswith(BUILTIN):
        return read_motions(where, model), []
    motions: list[Motion] = []
    refusals: list[str] = []
    for path in motion_files(where):
        try:
            motions.append(read_motion(path, model))
        except ConfigError as error:
            refusals.append(str(error))
    return motions, refusals


def _draw(motions: "Sequence[Motion]", model: "mujoco.MjModel", count: int, path: Path) -> str:
    """Draw a row of `count` frames for each motion; returns a line that says where, or why not."""
    import mujoco
    import numpy as np

    from msk_ray.visualize.film import grid
    from msk_ray.visualize.render import States, View, frames

    # A clip has no forces: those of its overlapping parts would be drawn as arrows across the picture.
    model = copy.copy(model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    images, captions = [], []
    try:
        for motion in motions:
            numbers = np.unique(np.linspace(0, len(motion) - 1, count).round().astype(int))
            zeros = [np.zeros((len(numbers), size)) for size in (model.nv, model.na, model.nu)]
            images.append(list(frames(States(model, motion.qpos[numbers], *zeros), View(width=240, height=240))))
            captions.append([f"{number / motion.rate:.1f} s" for number in numbers])
    except DeviceError as error:
        return f"nothing drawn: {error}"
    grid(images, [motion.name for motion in motions], captions).save(path)
    return f"drawn in {path}"


if __name__ == "__main__":
    sys.exit(run(main))
