"""Draw the evaluation score of several trials over wall-clock, env steps or epochs, grouped by label.

    python lab/benchmarks/score_over_time.py out.png 'SHAC=runs/ant_s*' 'PPO=runs/ppo_s*'

Each group has a colour, with a thin line per trial (its seeds); the thick line is the median where all trials have a
score.
"""

import argparse
import glob
from pathlib import Path

import matplotlib
import numpy as np

from msk_ray.training import read_metrics

matplotlib.use("Agg")
from matplotlib import pyplot  # the backend has to be chosen first

AXES = {"seconds": "training and evaluation time [s]", "env_steps": "env steps", "epoch": "epoch"}


def main() -> None:
    """Draw what the command line names."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("output", type=Path)
    p.add_argument("groups", nargs="+", metavar="LABEL=FOLDERS", help="folders of trials, with * as a wildcard")
    p.add_argument("--x", choices=sorted(AXES), default="seconds")
    p.add_argument("--fields", nargs="+", default=["eval/score", "eval/vx"])
    p.add_argument("--marks", nargs="+", type=float, default=[], help="scores to mark by a line")
    args = p.parse_args()
    figure, axes = pyplot.subplots(1, len(args.fields), figsize=(5.2 * len(args.fields), 3.8), squeeze=False)
    for index, group in enumerate(args.groups):
        label, _, pattern = group.partition("=")
        folders = sorted(glob.glob(pattern))
        if not folders:
            raise SystemExit(f"no folder matches {pattern!r} (group {label!r})")
        trials = [read_metrics(Path(folder) / "metrics.jsonl") for folder in folders]
        for axis, field in zip(axes[0], args.fields, strict=True):
            curves = [np.array([(row[args.x], row[field]) for row in rows if field in row]) for rows in trials]
            for curve in curves:
                axis.plot(curve[:, 0], curve[:, 1], color=f"C{index}", linewidth=0.8, alpha=0.5)
            end = min(curve[-1, 0] for curve in curves)
            common = np.linspace(0.0, end, 100)
            middle = np.median([np.interp(common, curve[:, 0], curve[:, 1]) for curve in curves], axis=0)
            axis.plot(common, middle, color=f"C{index}", linewidth=2.2, label=f"{label} ({len(curves)})")
    for axis, field in zip(axes[0], args.fields, strict=True):
        axis.set_xlabel(AXES[args.x])
        axis.set_ylabel(field.removeprefix("eval/") + (" [m/s]" if field.endswith("vx") else ""))
        axis.grid(alpha=0.3)
    for mark in args.marks:
        axes[0, 0].axhline(mark, color="grey", linewidth=0.7, linestyle="--")
    axes[0, 0].legend()
    figure.tight_layout()
    figure.savefig(args.output, dpi=110)
    print(f"written: {args.output}")


if __name__ == "__main__":
    main()
