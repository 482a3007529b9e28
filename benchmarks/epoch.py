"""How long an epoch of training takes, for several numbers of worlds, settings and checkouts of the project.

    python benchmarks/epoch.py --worlds 64 4096
    python benchmarks/epoch.py --worlds 4096 --vary "execution.capture=off" --vary "physics.backward=tape_all"
    python benchmarks/epoch.py --trees . ../before        # the same on another checkout, in turn
    python benchmarks/epoch.py --worlds 4096 --epochs 796 --trees . ../before     # all of configs/ant.yaml

An epoch is measured as `msk_ray.train` runs it: with evaluations, metrics, loggers and checkpoints as configured. The
time is that of `--epochs` epochs, with what is scored at their end, divided by their number; the evaluation is its mean
share, the other parts are medians, and of several rounds, in which the variants take turns, the medians are shown.
Where epochs are recorded, parts overlap, so they do not sum to the epoch. If policies are scored several at a time, the
share is that of a whole run only if `--epochs` is its length.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from record import RESULTS, markdown_table, publish

from msk_ray.config import load_config
from msk_ray.experiment.metrics import read_rows
from msk_ray.train import train

WARM_UP = 4
"""Epochs before those that are timed: kernels are compiled in the first and recorded in the next."""
PARTS = ("rollout", "backward", "critic", "evaluation")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    import torch

    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--config", type=Path, default=Path("configs/ant.yaml"))
    p.add_argument("--worlds", type=int, nargs="+", default=[16])
    p.add_argument("--epochs", type=int, default=20, help=f"timed epochs; {WARM_UP} more come before them")
    p.add_argument("--without-evaluation", action="store_true", help="evaluate one env step of one world, at the end")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    p.add_argument(
        "--vary", action="append", default=[], metavar="KEY=VALUE", help="measure once more with this setting"
    )
    p.add_argument("--trees", type=Path, nargs="+", default=[Path()], help="checkouts to compare (default: this one)")
    p.add_argument("--rounds", type=int, default=1, help="runs of each variant, in turn")
    p.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    p.add_argument("--one", action="store_true", help=argparse.SUPPRESS)  # measure here, and print the figures
    return p


def main() -> None:
    """Run the benchmark the command line asks for."""
    args = parser().parse_args()
    if args.one:
        print(json.dumps(measure(args.config, args.worlds[0], args)))
        return
    rows = []
    for worlds in args.worlds:
        variants = [(vary, tree) for vary in ["", *args.vary] for tree in args.trees]
        runs = [[elsewhere(tree, worlds, vary, args) for vary, tree in variants] for _ in range(args.rounds)]
        for (vary, tree), own in zip(variants, zip(*runs, strict=True), strict=True):
            found = {key: statistics.median(run[key] for run in own) for key in own[0]}
            label = ", ".join(part for part in (vary, tree.resolve().name if len(args.trees) > 1 else "") if part)
            parts = [f"{1e3 * found[part]:.1f}" if part in found else "-" for part in PARTS]
            speed = f"{found['env_steps'] / found['epoch']:,.0f}"
            rows.append([f"{worlds}", label or "-", *parts, f"{1e3 * found['epoch']:.1f}", speed])
            print(rows[-1], flush=True)
    title = f"SHAC epoch, {args.config.stem}" + ("" if args.without_evaluation else ", evaluations included")
    header = ["worlds", "variant", *(f"{part} ms" for part in PARTS), "epoch ms", "env steps/s"]
    publish("epoch", title, args.device, markdown_table(header, rows), args.results)


def elsewhere(tree: Path, worlds: int, vary: str, args: argparse.Namespace) -> dict[str, float]:
    """Figures from a process of its own, which imports the package of a checkout."""
    settings = [f"--set={value}" for value in (*args.overrides, *([vary] if vary else []))]
    command = [sys.executable, __file__, "--one", "--config", str(args.config), "--worlds", str(worlds), *settings]
    command += [
        "--epochs",
        str(args.epochs),
        "--device",
        args.device,
    ]
    command += ["--without-evaluation"] if args.without_evaluation else []
    path = os.pathsep.join([str(tree.resolve()), os.environ.get("PYTHONPATH", "")])
    run = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, float] = json.loads(run.stdout.splitlines()[-1])
    return found


def measure(path: Path, worlds: int, args: argparse.Namespace) -> dict[str, float]:
    """Mean duration of an epoch and of its share of the evaluations [s], medians of its other parts [s], and its env
    steps."""
    import torch

    marks: list[float] = []

    def now() -> float:
        if args.device != "cpu":
            torch.cuda.synchronize()
        return time.perf_counter()

    def on_epoch(row: dict[str, float]) -> None:
        if row["epoch"] == WARM_UP:
            marks.append(now())

    epochs = WARM_UP + args.epochs
    rare = ["evaluation.nworld=1", "evaluation.steps=1", f"evaluation.interval={epochs}"]
    overrides = [f"env.nworld={worlds}", f"trial.epochs={epochs}", *(rare if args.without_evaluation else [])]
    config = load_config(path, [*args.overrides, *overrides])
    with tempfile.TemporaryDirectory() as folder:
        train(config, Path(folder) / "trial", args.device, on_epoch=on_epoch)
        seconds = (now() - marks[0]) / args.epochs
        rows = [row for row in read_rows(Path(folder) / "trial") if row["epoch"] > WARM_UP]
    found: dict[str, Any] = {
        part: statistics.median(row[f"time/{part}_s"] for row in rows)
        for part in PARTS[:-1]
        if all(f"time/{part}_s" in row for row in rows)
    }
    evaluation = sum(row.get("time/evaluation_s", 0.0) for row in rows) / args.epochs
    return {
        "epoch": seconds,
        "env_steps": (rows[-1]["env_steps"] - rows[0]["env_steps"]) / (len(rows) - 1),
        **found,
        "evaluation": evaluation,
    }


if __name__ == "__main__":
    main()
