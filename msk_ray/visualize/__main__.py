"""`python -m msk_ray.visualize`: pictures of a policy."""

import argparse
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from msk_ray.cli import STORAGE, Parser, geom_group_list, positive, run
from msk_ray.compiling import announce_compiling
from msk_ray.errors import CheckpointError, ConfigError
from msk_ray.evaluate.targets import REFERENCE, Target, best_trial_folder, checkpoint_of, find_target
from msk_ray.files import make_folder
from msk_ray.progress import Pace, announce
from msk_ray.sweep.space import parse_seeds
from msk_ray.text_table import text_table

if TYPE_CHECKING:
    import mujoco
    import numpy as np

    from msk_ray.evaluate.measure import Bench, Request
    from msk_ray.visualize.recording import Recording
    from msk_ray.visualize.render import View

DESCRIPTION = """\
Draw a policy's episodes as video, frames or film strip, or print their statistics; no display is needed. msk-ray play
opens a viewer.

Episodes are as in evaluation: without noise, from fixed initial states, under reference physics unless --physics says
otherwise. Contact forces are arrows (a force equal to the model's weight is as long as the model is large), muscles go
from blue (relaxed) to red (active). A trial stands for its best policy, an experiment for its best trial."""

EXAMPLES = """\
  python -m msk_ray.visualize runs/demo --no-render --episodes 10        # statistics, no pictures
  python -m msk_ray.visualize runs/demo/trials/1a2b3c4d --video out.mp4 --fps 30
  python -m msk_ray.visualize runs/demo --strip out.png --frames 8
  python -m msk_ray.visualize runs/demo --save-frames frames/
  python -m msk_ray.visualize --progression runs/demo --strip out.png    # policies over training × time

Without a display, EGL or OSMesa is used, whichever works; MUJOCO_GL=egl or MUJOCO_GL=osmesa chooses one of them."""

PROGRESSION_FRAMES = 6


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.visualize", DESCRIPTION, EXAMPLES)
    p.add_argument("target", nargs="?", metavar="CHECKPOINT|TRIAL|EXPERIMENT", help="what to draw")
    output = p.add_argument_group("what to make")
    output.add_argument("--no-render", action="store_true", help="print statistics of the episodes, draw nothing")
    output.add_argument(
        "--video",
        type=Path,
        metavar="FILE",
        help="an .mp4, .mkv, .mov or .gif; drawing takes long without a GPU: see --steps, --fps, --size",
    )
    output.add_argument("--save-frames", type=Path, metavar="DIR", help="numbered .png files")
    output.add_argument("--strip", type=Path, metavar="FILE", help="frames side by side, evenly spaced over an episode")
    output.add_argument(
        "--progression",
        metavar="EXPERIMENT|TRIAL",
        help="one row of frames for each policy that a trial (or the best trial) saved during training, in the FILE of "
        "--strip or progression.png",
    )
    how = p.add_argument_group("episodes and drawing")
    how.add_argument(
        "--episodes",
        type=positive,
        metavar="N",
        help="number of episodes (default: 1; with --no-render 10)",
    )
    how.add_argument(
        "--seed", type=int, metavar="N", help="seed of the initial states (default: the trial's evaluation seed)"
    )
    how.add_argument("--steps", type=positive, metavar="N", help="maximum env steps per episode")
    how.add_argument(
        "--physics",
        default=REFERENCE,
        metavar="NAME",
        help="reference (used for scores), own (used in training), or the name of one (default: reference)",
    )
    how.add_argument(
        "--frames",
        type=positive,
        metavar="N",
        help="frames in a strip (default: 8) or in a row of --progression (default: 6)",
    )
    how.add_argument("--fps", type=float, default=30.0, metavar="F", help="frames per simulated second (default: 30)")
    how.add_argument("--size", type=_size, metavar="WxH", help="size of a frame, such as 640x480; both numbers even")
    how.add_argument("--camera", default="", metavar="NAME", help="a camera of the model (default: its first)")
    how.add_argument(
        "--geom-groups",
        type=geom_group_list,
        metavar="LIST",
        help="groups of geoms to draw, such as 0,3 (default: 0,1,2, and the robot's own if it has no geom in these)",
    )
    how.add_argument("--device", help="cpu or cuda:N, to simulate (default: the first GPU, or the CPU)")
    how.add_argument("--storage", **STORAGE)
    return p


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if match is None or any(int(n) < 16 or int(n) % 2 for n in match.groups()):
        raise argparse.ArgumentTypeError(f"write WIDTHxHEIGHT, both even and at least 16, such as 640x480, not {text}")
    return int(match[1]), int(match[2])


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    target = _check(args)
    announce_compiling(f"running {_what(args, target)}")
    from msk_ray.evaluate.measure import Bench, Request, default_device
    from msk_ray.step.autograd.simulation import resolve_device
    from msk_ray.training import load_policy

    seeds = None if args.seed is None else (args.seed,)
    device = args.device or default_device()
    resolve_device(device)
    bench = Bench(device, tell=True)
    if args.progression is not None:
        return _progression(args, target, bench, Request(args.physics, 1, seeds, args.steps))
    policy = load_policy(checkpoint_of(target))
    from msk_ray.visualize.recording import record
    from msk_ray.visualize.render import check_camera

    count = args.episodes or (10 if args.no_render else 1)
    request = Request(args.physics, count, seeds, args.steps)
    drawing = not args.no_render
    if drawing:
        check_camera(bench.evaluator(policy.config, request)[0].env.model, args.camera)
    recording = record(bench, policy, request)
    print(f"{policy.path}, epoch {policy.epoch}, under {recording.physics} physics")
    print(episode_table(recording))
    if drawing:
        _say_groups(args, recording.model)
        _draw(args, recording)
    return 0


def _check(args: argparse.Namespace) -> Target:
    """The target. Refuses a command line that cannot work, before anything slow starts."""
    given = args.progression if args.progression is not None else args.target
    if given is None or (args.progression is not None and args.target is not None):
        raise ConfigError("name one thing to draw: a checkpoint, a trial, or an experiment")
    if not 0.0 < args.fps <= 1000.0:  # NaN is neither
        raise ConfigError(f"--fps {args.fps:g}: write a number above 0, up to 1000")
    if args.seed is not None:
        parse_seeds(args.seed)
    target = find_target(given, args.storage)
    checkpoint_of(target)
    drawing = args.video or args.save_frames or args.strip or args.progression is not None
    if not drawing and not args.no_render:
        raise ConfigError(
            "say what to make: --video FILE, --strip FILE, --save-frames DIR, --no-render; msk-ray play opens a viewer"
        )
    if args.no_render and drawing:
        raise ConfigError(
            "--no-render draws nothing: leave it out, or leave out --video, --save-frames, --strip and --progression"
        )
    if args.no_render and args.geom_groups is not None:
        raise ConfigError("--geom-groups: --no-render draws nothing; leave out one of the two")
    _check_files(args)
    if drawing:
        from msk_ray.visualize.render import headless_backend

        headless_backend()
    return target


def _check_files(args: argparse.Namespace) -> None:
    """Refuse files that could not be written at the end."""
    from msk_ray.visualize.film import check_image_path, check_video_path

    if args.video is not None:
        check_video_path(args.video)
        make_folder(args.video.parent)
    if args.strip is not None:
        check_image_path(args.strip)
        make_folder(args.strip.parent)
    if args.save_frames is not None:
        make_folder(args.save_frames)


def _what(args: argparse.Namespace, target: Target) -> str:
    """The episodes that the command line asks for."""
    if args.progression is not None:
        return f"an episode of each policy that {best_trial_folder(target)} saved during training"
    count = args.episodes or (10 if args.no_render else 1)
    number = "1 episode" if count == 1 else f"{count} episodes at once"
    return f"{number} of {checkpoint_of(target)}"


def episode_table(recording: "Recording") -> str:
    """Statistics of the episodes for a terminal."""
    episodes = recording.episodes
    names = list(episodes.outcomes)
    means = {name: episodes.outcomes[name] / episodes.length for name in names}
    rows = [
        (
            str(world),
            f"{float(episodes.score[world]):.5g}",
            str(recording.length(world)),
            f"{recording.length(world) * recording.timestep:.2f}",
            *(f"{float(means[name][world]):.3g}" for name in names),
            recording.ending(world),
        )
        for world in range(recording.count)
    ]
    if recording.count > 1:
        columns = [episodes.score, episodes.length, episodes.length * recording.timestep, *means.values()]
        texts = [f"{float(c.mean()):.4g} ± {float(c.std()):.2g}" for c in columns]
        rows.append(("mean ± std", *texts, f"{float(episodes.fell.float().mean()):.0%} fell"))
    return text_table(("episode", "score", "steps", "seconds", *names, "ended by"), rows, 160)


def _say_groups(args: argparse.Namespace, model: "mujoco.MjModel") -> None:
    """Tell the user if more geoms are drawn than MuJoCo would draw."""
    from msk_ray.visualize.look import describe_groups, geom_groups

    if args.geom_groups is None and (drawn := describe_groups(geom_groups(model))):
        print(f"{drawn}; --geom-groups chooses")


def _draw(args: argparse.Namespace, recording: "Recording") -> None:
    from msk_ray.visualize.film import save_image, strip, write_frames, write_video
    from msk_ray.visualize.render import View
    from msk_ray.visualize.strips import episode_frames

    width, height = args.size or (640, 480)
    view = View(width, height, args.camera, args.geom_groups)
    if args.video:
        args.video.parent.mkdir(parents=True, exist_ok=True)
        print(f"{write_video(_film(recording, args.fps, view), args.video, args.fps)} frames in {args.video}")
    if args.save_frames:
        print(f"{write_frames(_film(recording, args.fps, view), args.save_frames)} frames in {args.save_frames}/")
    if args.strip:
        width, height = args.size or (320, 240)
        image = strip(*episode_frames(recording, args.frames or 8, View(width, height, args.camera, args.geom_groups)))
        save_image(image, args.strip)
        print(f"strip of {args.frames or 8} frames in {args.strip}")


def _film(recording: "Recording", fps: float, view: "View") -> Iterator["np.ndarray"]:
    """Frames (height, width, 3), uint8, of all episodes, one after the other; prints progress."""
    from msk_ray.visualize.render import frames

    episodes = [recording.frames_at(world, fps) for world in range(recording.count)]
    total = sum(len(states) for states in episodes)
    announce(f"drawing {total} frames of {view.width}x{view.height} (fewer: --steps, --fps; smaller: --size)")
    pace = Pace("frames", total)
    for done, frame in enumerate((frame for states in episodes for frame in frames(states, view)), 1):
        yield frame
        pace(done)


def _progression(args: argparse.Namespace, target: Target, bench: "Bench", request: "Request") -> int:
    from msk_ray.training import load_policy
    from msk_ray.visualize.film import save_image
    from msk_ray.visualize.render import View
    from msk_ray.visualize.strips import progression

    folder = best_trial_folder(target)
    width, height = args.size or (240, 180)
    out = args.strip or Path("progression.png")
    view = View(width, height, args.camera, args.geom_groups)
    image, rows = progression(bench, folder, request, args.frames or PROGRESSION_FRAMES, view)
    if image is None:
        raise CheckpointError(f"{folder / 'checkpoints'} has no policies saved during training (policy_*.pt)")
    _say_groups(args, bench.evaluator(load_policy(checkpoint_of(target)).config, request)[0].env.model)
    save_image(image, out)
    print("\n".join(rows))
    print(f"{len(rows)} policies of {folder} in {out}")
    return 0


if __name__ == "__main__":
    sys.exit(run(main))
