"""Env steps per second of one SHAC trial on one GPU and on several, with the same worlds in all.

    python benchmarks/multi_gpu.py                              # 65,536 ants on one GPU and on two
    python benchmarks/multi_gpu.py --gpus 1 2 4 8 --set shac.horizon=32
    python benchmarks/multi_gpu.py --config configs/myoleg26.yaml --worlds 32768

Whole epochs without evaluations, as training runs them, with their rows of metrics. Each trial has processes of its
own. The last column compares the first epoch with that of the first number of GPUs: rounding alone should differ.
"""

import argparse
import itertools
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from record import RESULTS, markdown_table, publish

from msk_ray.config import load_config
from msk_ray.training import make_trainer

WARM_UP = 4
"""Epochs before those that are timed: kernels are compiled in the first and recorded in the next."""
COMPARED = ("train/reward", "train/actor_loss", "train/value", "grad/actor_norm", "grad/state_p90")
"""Figures that show whether the trials learn the same."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    import torch

    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--config", type=Path, default=Path("configs/ant.yaml"))
    p.add_argument("--worlds", type=int, default=65536, help="in all")
    p.add_argument("--gpus", type=int, nargs="+", default=[1, 2])
    p.add_argument("--epochs", type=int, default=20, help=f"timed epochs; {WARM_UP} more come before them")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    p.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu", help="the first")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    p.add_argument("--one", type=int, help=argparse.SUPPRESS)  # measure this number of GPUs here, and print the figures
    return p


def main() -> None:
    """Run the benchmark the command line asks for."""
    args = parser().parse_args()
    if args.one is not None:
        print(json.dumps(measure(args.one, args)))
        return
    rows: list[list[str]] = []
    alone: dict[str, Any] | None = None
    for gpus in args.gpus:
        found = elsewhere(gpus)
        alone = alone or found
        speed = found["env_steps_per_s"]
        gaps = [abs(found["first"][name] / alone["first"][name] - 1.0) for name in COMPARED]
        rows.append(
            [
                f"{gpus}",
                f"{args.worlds // gpus}",
                f"{1e3 * found['epoch_s']:.1f}",
                f"{1e3 * found['slowest_s']:.1f}",
                f"{speed:,.0f}",
                f"{speed / alone['env_steps_per_s']:.2f}",
                f"{found['recorded']:.0%}",
                f"{max(gaps):.0e}",
            ]
        )
        print(rows[-1], flush=True)
    header = ["GPUs", "worlds each", "epoch ms", "slowest ms", "env steps/s", f"relative to {args.gpus[0]}"]
    header += ["recorded", "first epoch differs by"]
    title = f"One SHAC trial of {args.worlds} worlds on several GPUs, {args.config.stem}"
    publish("multi_gpu", title, args.device, markdown_table(header, rows), args.results)


def elsewhere(gpus: int) -> dict[str, Any]:
    """Figures from a process of its own, which leaves the GPUs empty."""
    command = [sys.executable, __file__, *sys.argv[1:], "--one", str(gpus)]
    run = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, Any] = json.loads(run.stdout.splitlines()[-1])
    return found


def measure(gpus: int, args: argparse.Namespace) -> dict[str, Any]:
    """Mean and longest duration of an epoch [s], env steps per second, how many of the timed epochs were recorded, and
    the row of the first."""
    never = ["evaluation.nworld=1", "evaluation.steps=1", "evaluation.interval=1000000"]
    overrides = [*never, "trial.epochs=1000000", "execution.checkpoint_interval=1000000", f"execution.gpus={gpus}"]
    config = load_config(args.config, [*args.overrides, f"env.nworld={args.worlds}", *overrides])
    with tempfile.TemporaryDirectory() as folder:
        trainer = make_trainer(config, Path(folder), args.device)
        first, *_ = [trainer.run_epoch() for _ in range(WARM_UP)]
        rows, times = [], [time.perf_counter()]
        for _ in range(args.epochs):
            rows.append(trainer.run_epoch())  # waits for the device, to read the epoch's figures
            times.append(time.perf_counter())
        trainer.close()
    seconds = [after - before for before, after in itertools.pairwise(times)]
    steps = rows[-1]["env_steps"] - rows[0]["env_steps"]
    return {
        "epoch_s": statistics.mean(seconds),
        "slowest_s": max(seconds),
        "env_steps_per_s": steps / (len(rows) - 1) / statistics.mean(seconds),
        "recorded": statistics.mean(row["train/recorded"] for row in rows),
        "first": {name: first[name] for name in COMPARED},
    }


if __name__ == "__main__":
    main()
