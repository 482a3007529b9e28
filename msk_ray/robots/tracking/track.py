"""`msk-ray track`: scores of a policy on each clip (`clip_scores.py`)."""

import csv
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from msk_ray.cli import STORAGE, Parser, run
from msk_ray.compiling import announce_compiling
from msk_ray.evaluate.targets import checkpoint_of, find_target, trial_folder_of
from msk_ray.files import make_folder, write_json
from msk_ray.progress import Pace
from msk_ray.shipped import is_shipped
from msk_ray.text_table import text_table

if TYPE_CHECKING:
    from msk_ray.robots.tracking.clip_scores import ClipScore

DESCRIPTION = """\
Let a policy of g1_tracking follow each clip once, from its first frame and without noise. A clip fails when the pelvis
is off by more than 0.25 m in height, or by 0.8 in the vertical component of gravity in its axes; a failed clip earns
nothing more. Returns are divided by the largest possible return. Writes clips.csv, with a row for each clip, and
clips.json into the trial's folder, or into --out; for a policy of the package, or other clips, only into --out."""

EXAMPLES = """\
  msk-ray track runs/train/g1_tracking_seed0
  msk-ray track runs/train/g1_tracking_seed0 --motion g1/ --out all     # clips that it was not trained on"""


def parser() -> Parser:
    """The command line."""
    p = Parser("msk-ray track", DESCRIPTION, EXAMPLES)
    p.add_argument(
        "target", metavar="CHECKPOINT|TRIAL|EXPERIMENT", help="the policy, or where to take the best one from"
    )
    p.add_argument(
        "--motion",
        metavar="PATH",
        help="clips to follow, as in env.motion (default: those it was trained on); env.cut and env.mirror stay",
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="folder to write to (default: the trial's)")
    p.add_argument("--device", help="cpu or cuda:N (default: the first GPU, or the CPU if there is none)")
    p.add_argument("--storage", **STORAGE)
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    path = checkpoint_of(find_target(args.target, args.storage))
    announce_compiling(f"following clips with {path}")

    from msk_ray.evaluate.measure import default_device
    from msk_ray.robots.tracking.clip_scores import as_json, follow_clips, totals
    from msk_ray.training import load_policy

    policy = load_policy(path)
    scores = follow_clips(
        policy, args.device or default_device(), args.motion, lambda steps: Pace("env steps at most", steps)
    )
    print(_table(scores))
    overall = totals(scores)
    print(
        f"{overall['failed']} of {overall['clips']} failed; return {overall['normalised_return']:.3f} (mean of the "
        f"clips), {overall['normalised_return_by_frame']:.3f} (mean of the frames), motion "
        f"{overall['normalised_motion']:.3f}, without costs; "
        f"mpkpe {1000.0 * overall['mpkpe']:.0f} mm, r_mpkpe {1000.0 * overall['r_mpkpe']:.0f} mm"
    )
    if args.out is None and (is_shipped(path) or args.motion is not None):
        print("not written: add --out DIR")
        return 0
    out = args.out or trial_folder_of(path)
    make_folder(out)
    write_json(out / "clips.json", as_json(scores, policy, args.motion))
    _write_csv(out / "clips.csv", scores)
    print(f"written into {out / 'clips.csv'} and {out / 'clips.json'}")
    return 0


def _write_csv(path: Path, scores: "Sequence[ClipScore]") -> None:
    """Write one row for each clip."""
    rows = [asdict(score) for score in scores]
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


def _table(scores: "Sequence[ClipScore]") -> str:
    """One line for each clip, for a terminal."""
    rows = [
        (
            *(score.clip, f"{score.seconds:.1f}", "failed" if score.failed else "-", f"{score.followed:.0%}"),
            *(f"{value:.3f}" for value in (score.normalised_return, score.normalised_motion)),
            *(f"{1000.0 * value:.0f}" for value in (score.mpkpe, score.r_mpkpe)),
        )
        for score in scores
    ]
    header = ("clip", "seconds", "failed", "followed", "return", "motion", "mpkpe [mm]", "r_mpkpe [mm]")
    return text_table(header, rows, 160)


if __name__ == "__main__":
    sys.exit(run(main))
