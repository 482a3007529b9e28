"""`msk-ray gait`: how does a policy walk, compared with people?"""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msk_ray.cli import Parser, positive, run
from msk_ray.compiling import announce_compiling
from msk_ray.errors import ConfigError, brief
from msk_ray.evaluate.stored import eval_file_of, store_evaluation
from msk_ray.evaluate.targets import checkpoint_of, find_target, trial_folder_of
from msk_ray.files import make_folder, write_json
from msk_ray.shipped import is_shipped
from msk_ray.text_table import text_table

DESCRIPTION = """\
Measure the gait of a policy of a leg environment (myoleg26, myoleg, myosuite_walk): speed, cadence, step length, duty
factor, joint angles and ground reaction over the gait cycle, symmetry, cost and falls, compared with healthy people,
and the gait distance, one number for all of it (about 1 for a healthy person, 10 for one who does not walk).

Episodes are those of the evaluation: without noise or assistance, from fixed initial states. Their first second is
left out. They are measured at every physics substep, which C MuJoCo repeats from the state at each env step. Writes
gait.json and gait.png into the trial's folder or that of --out, and adds the gait to its eval.json. Several policies
are compared in one table; with --speeds, each is told these speeds one after the other, and speeds.png shows cadence
and step length against speed."""

EXAMPLES = """\
  msk-ray gait runs/train/myoleg26_seed0
  msk-ray gait myoleg26_reward --worlds 64 --out gait/          # the best trial of an experiment
  msk-ray gait runs/train/myoleg26_seed0 --film stride.gif       # beside people's, as stick figures
  msk-ray gait runs/a runs/b/checkpoints/epoch_000400.pt        # side by side
  msk-ray gait runs/train/fast_seed0 --speeds 0.7,1,1.25,1.6    # a policy that is told its speed"""


def parser() -> Parser:
    """The command line."""
    p = Parser("msk-ray gait", DESCRIPTION, EXAMPLES)
    p.add_argument(
        "targets",
        nargs="+",
        metavar="CHECKPOINT|TRIAL|EXPERIMENT",
        help="the policies to measure: themselves, or the best ones",
    )
    p.add_argument("--speeds", metavar="LIST", help="target speeds [m/s], such as 0.7,1.25 (default: the trial's)")
    p.add_argument(
        "--film",
        type=Path,
        metavar="FILE",
        help="draw a stride from the side beside people's: a .gif, .mp4, .mkv or .mov",
    )
    p.add_argument("--worlds", type=positive, default=16, metavar="W", help="episodes (default: %(default)s)")
    p.add_argument("--steps", type=positive, metavar="N", help="maximum env steps per episode")
    p.add_argument("--out", type=Path, metavar="DIR", help="folder to write to (default: the trial's)")
    p.add_argument("--device", help="cpu or cuda:N (default: the first GPU, or the CPU if there is none)")
    p.add_argument(
        "--storage", type=Path, default=Path("runs"), metavar="DIR", help="folder of experiments (default: runs/)"
    )
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    paths = [checkpoint_of(find_target(target, args.storage)) for target in args.targets]
    shipped = next(filter(is_shipped, paths), None)
    if shipped is not None and args.out is None:
        raise ConfigError(f"{shipped} belongs to the package, which nothing is written into: add --out DIR")
    if args.film is not None:
        _check_film(args)
    speeds: list[float | None] = [None] if args.speeds is None else [*_speeds(args.speeds)]
    what = paths[0] if len(paths) == 1 else f"{len(paths)} policies"
    announce_compiling(f"measuring the gait of {what}")

    from msk_ray.envs.make import env_class
    from msk_ray.evaluate.measure import Bench, Request, default_device
    from msk_ray.legs.env import LegEnv
    from msk_ray.legs.gait.picture import draw, draw_speeds
    from msk_ray.legs.gait.walk import at_target_speed, walk
    from msk_ray.training import load_policy

    bench = Bench(args.device or default_device(), tell=True)
    request = Request(worlds=args.worlds, steps=args.steps)
    rows: list[tuple[str, dict[str, Any]]] = []
    for path in paths:
        policy = load_policy(path)
        if args.film is not None and not issubclass(env_class(policy.config.env), LegEnv):
            raise ConfigError(f"--film: env {policy.config.env.name} has no poses of people; leave it out")
        told: list[tuple[float, dict[str, Any]]] = []
        for speed in speeds:
            found = walk(bench, policy if speed is None else at_target_speed(policy, speed), request)
            gait, suffix = found.gait, "" if speed is None else f"_{speed:g}"
            out = args.out or trial_folder_of(path)
            make_folder(out)
            name = f"gait{suffix}" if len(paths) == 1 or args.out is None else f"gait_{len(rows)}{suffix}"
            facts = {"checkpoint": path.name, "epoch": policy.epoch, "physics": found.entry["physics"]}
            write_json(out / f"{name}.json", facts | gait)
            draw(gait, f"{path.name}, epoch {policy.epoch}", out / f"{name}.png")
            if speed is None and not is_shipped(path):
                store_evaluation(eval_file_of(path), found.entry)
            if len(paths) == len(speeds) == 1:
                print(gait_text(gait))
            print(f"written into {out / name}.json and {out / name}.png")
            if args.film is not None:
                from msk_ray.legs.gait.stick import figures, film, one_stride

                stride, seconds = one_stride(found.episodes, found.qpos)
                assert isinstance(found.env, LegEnv)
                model, people = found.env.model, found.env.people_poses()
                film(figures(model, stride), figures(model, people), seconds, args.film)
                print(f"written into {args.film}")
            rows.append((f"{trial_folder_of(path).name}/{path.name}{suffix}", gait))
            if speed is not None:
                told.append((speed, gait))
        if len(told) > 1:
            name = "speeds" if len(paths) == 1 or args.out is None else f"speeds_{len(rows)}"
            draw_speeds(told, f"{path.name}, epoch {policy.epoch}", out / f"{name}.png")
            print(f"written into {out / name}.png")
    if len(rows) > 1:
        print(side_by_side(rows))
    return 0


def _check_film(args: argparse.Namespace) -> None:
    """Refuse a film that cannot be made, before anything is computed."""
    from msk_ray.visualize.film import check_video_path

    check_video_path(args.film)
    if len(args.targets) > 1 or args.speeds is not None:
        raise ConfigError("--film draws one stride: name one policy, and leave --speeds out")


def _speeds(text: str) -> list[float]:
    """The speeds that `--speeds` asks for.

    Raises:
        ConfigError: one is no positive number.
    """
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = [math.nan]
    if not all(math.isfinite(speed) and speed > 0.0 for speed in found):
        raise ConfigError(f"--speeds {brief(text)}: write positive numbers, such as 0.7,1.25")
    return found


def side_by_side(rows: Sequence[tuple[str, dict[str, Any]]]) -> str:
    """Gaits of several policies or speeds, one a row."""
    header = ("policy", "distance", "speed", "cadence", "step", "duty", "asymmetry", "cost", "fell", *_JOINTS)
    table = []
    for name, gait in rows:
        values = {key: entry["value"] for key, entry in gait["measures"].items()}
        shown = [gait["gait_distance"], values["speed"], values["cadence"], values["step_length"]]
        shown += [values["duty_factor"], values["symmetry_step_length"], gait["costs"]["cost_of_transport"]]
        inside = [gait["people"].get(curve, {}).get(_inside(curve)) for curve in _JOINTS.values()]
        cells = ["-" if value is None else f"{value:.3g}" for value in shown]
        shares = ["-" if value is None else f"{value:.0%}" for value in (gait["falls"], *inside)]
        table.append((name, *cells, *shares))
    return text_table(header, table, 160) + "\nhip to force: share of the cycle inside the mean ± 2 SD of people"


_JOINTS = {"hip": "hip_flexion", "knee": "knee_flexion", "ankle": "ankle_dorsiflexion", "force": "vertical_force"}


def _inside(curve: str) -> str:
    """The share that is shown for a curve: without its mean where the zero differs between models."""
    from msk_ray.legs.gait.compare import CENTRED  # torch takes seconds to load

    return "within_centred" if curve in CENTRED else "within"


def gait_text(gait: dict[str, Any]) -> str:
    """Measures and landmarks for a terminal."""
    rows = []
    for name, entry in (*gait["measures"].items(), *gait["landmarks"].items()):
        value = "-" if entry["value"] is None else f"{entry['value']:.4g}"
        within = {None: "-", True: "yes", False: "no"}[entry["within"]]
        rows.append((name, value, "{:g} to {:g}".format(*entry["human"]), entry["unit"], within))
    for name, entry in gait["at_speed"].items():
        value = "-" if entry["value"] is None else f"{entry['value']:.4g}"
        within = {None: "-", True: "yes", False: "no"}[entry["within"]]
        rows.append((f"{name} at this speed", value, "{:.4g} to {:.4g}".format(*entry["people"]), "", within))
    for name, found in gait["people"].items():
        for part in ("rmse", "rmse_centred", "correlation", "within", "within_centred"):
            if found[part] is not None:
                rows.append((f"{name} {part.replace('_', ' ')}", f"{found[part]:.3g}", "", "", ""))
    for name, value in gait["timing"].items():
        rows.append((f"{name} correlation with emg", "-" if value is None else f"{value:.3g}", "", "", ""))
    for name, value in gait["costs"].items():
        rows.append((name, "-" if value is None else f"{value:.4g}", "", "", ""))
    falls = "-" if gait["falls"] is None else f"{gait['falls']:.0%}"
    return (
        text_table(("measure", "policy", "people", "unit", "within"), rows, 120)
        + f"\ngait distance {gait['gait_distance']:.3g}: "
        + ", ".join(f"{name} {value:.2g}" for name, value in gait["gait_distance_parts"].items())
        + f"\n{gait['strides']} strides in {gait['episodes']} episodes, {falls} of which ended in a fall"
    )


if __name__ == "__main__":
    sys.exit(run(main))
