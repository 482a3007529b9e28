"""`msk-ray track`: how well does a policy follow each clip?"""

import csv
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from msk_ray.cli import STORAGE, Parser, run
from msk_ray.compiling import announce_compiling
from msk_ray.errors import ConfigError
from msk_ray.evaluate.targets import best_checkpoint, find_target, trial_folder_of
from msk_ray.files import make_folder, write_json
from msk_ray.progress import Pace
from msk_ray.shipped import is_shipped
from msk_ray.text_table import text_table

DESCRIPTION = """\
Let a policy of g1_tracking follow each clip once, from its first frame, without noise. A clip fails where the pelvis is
off by more than 0.25 m in height, or by 0.8 in the vertical part of the direction of gravity in its axes; nothing is
earned afterwards. Returns are divided by their greatest value. Writes clips.csv, one row a clip, and clips.json into
the trial's folder or that of --out."""

EXAMPLES = """\
  msk-ray track runs/train/g1_tracking_seed0
  msk-ray track runs/train/g1_tracking_seed0 --motion g1/     # clips that it was not trained on"""


def parser() -> Parser:
    """The command line."""
    p = Parser("msk-ray track", DESCRIPTION, EXAMPLES)
    p.add_argument("target", metavar="CHECKPOINT|TRIAL|EXPERIMENT", help="the policy: itself, or the best one")
    p.add_argument("--motion", metavar="PATH", help="clips to follow, as env.motion (default: those of its training)")
    p.add_argument("--out", type=Path, metavar="DIR", help="folder to write to (default: the trial's)")
    p.add_argument("--device", help="cpu or cuda:N (default: the first GPU, or the CPU if there is none)")
    p.add_argument("--storage", **STORAGE)
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    path = best_checkpoint(find_target(args.target, args.storage))
    if args.out is None and is_shipped(path):
        raise ConfigError(f"{path} belongs to the package, which nothing is written into: add --out DIR")
    announce_compiling(f"following clips with {path}")

    from msk_ray.evaluate.measure import default_device
    from msk_ray.robots.tracking.clip_scores import as_json, follow_clips, totals
    from msk_ray.training import load_policy

    policy = load_policy(path)
    scores = follow_clips(
        policy, args.device or default_device(), args.motion, lambda steps: Pace("env steps at most", steps)
    )
    rows = [asdict(score) for score in scores]
    out = args.out or trial_folder_of(path)
    make_folder(out)
    write_json(out / "clips.json", as_json(scores, policy))
    with (out / "clips.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    shown = [
        (
            *(score.clip, f"{score.seconds:.1f}", "failed" if score.failed else "-", f"{score.followed:.0%}"),
            *(f"{value:.3f}" for value in (score.normalised_return, score.normalised_motion)),
            *(f"{1000.0 * value:.0f}" for value in (score.mpkpe, score.r_mpkpe)),
        )
        for score in scores
    ]
    header = ("clip", "seconds", "failed", "followed", "return", "motion", "mpkpe [mm]", "r_mpkpe [mm]")
    print(text_table(header, shown, 160))
    every = totals(scores)
    print(
        f"{every['failed']} of {every['clips']} failed; return {every['normalised_return']:.3f} (mean of the clips), "
        f"{every['by_time']:.3f} (mean of the frames), {every['normalised_motion']:.3f} without costs; mpkpe "
        f"{1000.0 * every['mpkpe']:.0f} mm, r_mpkpe {1000.0 * every['r_mpkpe']:.0f} mm"
    )
    print(f"written into {out / 'clips.csv'} and {out / 'clips.json'}")
    return 0


if __name__ == "__main__":
    sys.exit(run(main))
