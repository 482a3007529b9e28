"""How long an epoch of training takes, for several numbers of worlds, settings and checkouts of the project.

    python benchmarks/epoch.py --worlds 64 4096
    python benchmarks/epoch.py --worlds 4096 --vary "shac.capture=off" --vary "physics.backward=tape_all"
    python benchmarks/epoch.py --trees . ../before        # the same on another checkout, in turn

An epoch is measured as training runs it: with its row of metrics and the configured loggers, and with a share of the
evaluations if `--evaluate` is given. Its parts overlap where epochs are recorded, so they do not sum to it.
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
from msk_ray.training import Trainer

WARM_UP = 4
"""Epochs before those that are timed: kernels are compiled in the first and recorded in the next."""
PARTS = ("rollout", "backward", "critic")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    import torch

    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--config", type=Path, default=Path("configs/ant.yaml"))
    p.add_argument("--worlds", type=int, nargs="+", default=[16])
    p.add_argument("--epochs", type=int, default=20, help=f"timed epochs; {WARM_UP} more come before them")
    p.add_argument("--evaluate", action="store_true", help="evaluate as often as the config says, instead of never")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    p.add_argument(
        "--vary", action="append", default=[], metavar="KEY=VALUE", help="measure once more with this setting"
    )
    p.add_argument("--trees", type=Path, nargs="+", default=[Path()], help="checkouts to compare (default: this one)")
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
        for vary in ["", *args.vary]:
            for tree in args.trees:
                found = elsewhere(tree, worlds, vary, args)
                label = ", ".join(part for part in (vary, tree.resolve().name if len(args.trees) > 1 else "") if part)
                parts = [f"{1e3 * found[part]:.1f}" if part in found else "-" for part in PARTS]
                speed = f"{found['env_steps'] / found['epoch']:,.0f}"
                rows.append([f"{worlds}", label or "-", *parts, f"{1e3 * found['epoch']:.1f}", speed])
                print(rows[-1], flush=True)
    title = f"SHAC epoch, {args.config.stem}" + (", evaluations included" if args.evaluate else "")
    header = ["worlds", "variant", *(f"{part} ms" for part in PARTS), "epoch ms", "env steps/s"]
    publish("epoch", title, args.device, markdown_table(header, rows), args.results)


def elsewhere(tree: Path, worlds: int, vary: str, args: argparse.Namespace) -> dict[str, float]:
    """Figures from a process of its own, which imports the package of a checkout."""
    settings = [f"--set={value}" for value in (*args.overrides, *([vary] if vary else []))]
    command = [sys.executable, __file__, "--one", "--config", str(args.config), "--worlds", str(worlds), *settings]
    command += ["--epochs", str(args.epochs), "--device", args.device, *(["--evaluate"] if args.evaluate else [])]
    path = os.pathsep.join([str(tree.resolve()), os.environ.get("PYTHONPATH", "")])
    run = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, float] = json.loads(run.stdout.splitlines()[-1])
    return found


def measure(path: Path, worlds: int, args: argparse.Namespace) -> dict[str, float]:
    """Mean duration of an epoch [s], medians of its parts [s], and its env steps."""
    import torch

    def now() -> float:
        if args.device != "cpu":
            torch.cuda.synchronize()
        return time.perf_counter()

    never = ["evaluation.nworld=1", "evaluation.steps=1", "evaluation.interval=1000000"]
    overrides = [*([] if args.evaluate else never), "trial.epochs=1000000", "trial.checkpoint_interval=1000000"]
    config = load_config(path, [*args.overrides, f"env.nworld={worlds}", *overrides])
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(config, Path(folder), args.device)
        for _ in range(WARM_UP):
            trainer.run_epoch()
        started, rows = now(), []
        for _ in range(args.epochs):
            rows.append(trainer.run_epoch())
        seconds = (now() - started) / args.epochs
        trainer.close()
    parts: dict[str, Any] = {
        part: statistics.median(row[f"time/{part}_s"] for row in rows)
        for part in PARTS
        if all(f"time/{part}_s" in row for row in rows)
    }
    return {"epoch": seconds, "env_steps": (rows[-1]["env_steps"] - rows[0]["env_steps"]) / (len(rows) - 1), **parts}


if __name__ == "__main__":
    main()
