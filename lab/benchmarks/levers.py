"""What each setting that may make an epoch of training faster does to its time: each alone, and several together.

    python lab/benchmarks/levers.py --worlds 64 4096 16384
    python lab/benchmarks/levers.py --worlds 4096 --levers rows tape_all --together rows tape_all

An epoch is measured as `benchmarks/epoch.py` measures it, without evaluations, in one process for all settings. In each
round every setting has its turn; the table has the medians, and the change from the settings of the config. The last
columns are of the epoch before the last: the share of worlds in which the solver reached a limit or did not converge,
and the largest share of its rows that a world used.
"""

import argparse
import statistics
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from record import RESULTS, markdown_table, publish

from msk_ray.config import load_config
from msk_ray.experiment.metrics import read_rows
from msk_ray.train import train

WARM_UP = 4
"""Epochs before those that are timed: kernels are compiled in the first and recorded in the next."""
LEVERS = {
    "rows": ["physics.njmax=40"],
    "tape_all": ["physics.backward=tape_all"],
    "sparse": ["physics.jacobian=sparse"],
    "tf32": ["shac.critic_products=tf32"],
    "fused": ["shac.critic_kernels=fused"],
    "fused solver": ["physics.solver_kernels=fused"],
    "line search": ["physics.ls_iterations=10"],
    "iterations": ["physics.iterations=5"],
    "substeps": ["physics.substeps=2"],
    "batches": ["shac.critic_batches=2"],
    "passes": ["shac.critic_iterations=8"],
    "eager": ["shac.capture=off"],
}
"""Settings by the name of the lever. The last six change what is learned, or are there to compare with."""
TOGETHER = ["rows", "tape_all", "tf32", "fused"]
"""Levers that change results by rounding only."""
PARTS = ("rollout", "backward", "critic")
HEALTH = ("physics/solver_limit_share", "physics/solver_unconverged_share", "physics/rows_share")


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--config", type=Path, default=Path("configs/ant.yaml"))
    p.add_argument("--worlds", type=int, nargs="+", default=[16])
    p.add_argument("--levers", nargs="*", default=list(LEVERS), choices=list(LEVERS))
    p.add_argument("--together", nargs="*", default=TOGETHER, choices=list(LEVERS), help="levers of the last row")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    p.add_argument("--epochs", type=int, default=20, help=f"timed epochs; {WARM_UP} more come before them")
    p.add_argument("--rounds", type=int, default=1)
    p.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    variants: dict[str, list[str]] = {"as configured": [], **{name: LEVERS[name] for name in args.levers}}
    if args.together:
        variants[" + ".join(args.together)] = [setting for name in args.together for setting in LEVERS[name]]
    header = ["worlds", "lever", *(f"{part} ms" for part in PARTS), "epoch ms", "change", "at a limit", "unconverged"]
    header.append("rows used")
    rows = []
    for worlds in args.worlds:
        runs = [{name: measure(worlds, settings, args) for name, settings in variants.items()}]
        runs += [
            {n: measure(worlds, settings, args) for n, settings in variants.items()} for _ in range(args.rounds - 1)
        ]
        base = statistics.median(run["as configured"]["epoch"] for run in runs)
        for name in variants:
            found = {key: statistics.median(run[name][key] for run in runs) for key in runs[0][name]}
            parts = [f"{1e3 * found[part]:.1f}" for part in PARTS]
            change = f"{100 * (found['epoch'] / base - 1):+.1f} %"
            health = [f"{100 * found[key]:.2f} %" for key in HEALTH]
            rows.append([f"{worlds}", name, *parts, f"{1e3 * found['epoch']:.1f}", change, *health])
            print(rows[-1], flush=True)
    publish(
        "levers",
        f"SHAC epoch, {args.config.stem}, lever by lever",
        args.device,
        markdown_table(header, rows),
        args.results,
    )


def measure(worlds: int, settings: list[str], args: argparse.Namespace) -> dict[str, float]:
    """Medians of the durations of epochs and their parts [s], and how the solver and its buffers fared."""
    epochs = WARM_UP + args.epochs
    rare = ["evaluation.nworld=1", "evaluation.steps=1", f"evaluation.interval={epochs}"]
    config = load_config(
        args.config,
        [*args.overrides, f"env.nworld={worlds}", f"trial.epochs={epochs}", "trial.loggers=[]", *rare, *settings],
    )
    marks: list[float] = []

    def on_epoch(row: dict[str, Any]) -> None:
        # An epoch ends by reading its metrics, which waits for all but the fit of the critic.
        if WARM_UP <= row["epoch"] < epochs:
            marks.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as folder:
        train(config, Path(folder) / "trial", args.device, on_epoch=on_epoch)
        rows = [row for row in read_rows(Path(folder) / "trial") if WARM_UP < row["epoch"] < epochs]
    found = {part: statistics.median(row.get(f"time/{part}_s", 0.0) for row in rows) for part in PARTS}
    # The median, because some epochs are recorded once more. The last is left out: the final evaluation follows it.
    found["epoch"] = statistics.median(after - before for before, after in pairwise(marks))
    return found | {key: float(rows[-1].get(key, 0.0)) for key in HEALTH}


if __name__ == "__main__":
    main()
