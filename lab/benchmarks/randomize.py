"""Throughput of training with `physics.randomize` as a share of that without: epochs of both trials in turn."""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import torch
from record import RESULTS, markdown_table, publish

from msk_ray.config import load_config
from msk_ray.training import Trainer

DRAWN = (
    "physics.randomize={pair_friction: {low: 0.5, high: 1.5}, body_mass: {low: 0.8, high: 1.2, each: true}, "
    "actuator_gear: {low: 0.8, high: 1.2, each: true}}"
)


WARM_UP = 4
"""Epochs before those that are timed: the first run kernels eagerly, the next record them."""


def finish(device: str) -> None:
    """Wait for all work on the device."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--config", type=Path, default=Path("configs/ant.yaml"))
    p.add_argument("--worlds", type=int, nargs="+", default=[16])
    p.add_argument("--epochs", type=int, default=20, help="timed epochs of each, after the first")
    p.add_argument("--randomize", default=DRAWN, metavar="physics.randomize=VALUE")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    p.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    rows = []
    for worlds in args.worlds:
        overrides = [
            *args.overrides,
            f"env.nworld={worlds}",
            "evaluation.nworld=1",
            "evaluation.steps=1",
            "evaluation.interval=1000000",
            f"trial.epochs={args.epochs + 100}",
            "trial.checkpoint_interval=1000000",
        ]
        configs = [load_config(args.config, [*overrides, *more]) for more in ([], [args.randomize])]
        times: list[list[float]] = [[], []]
        with tempfile.TemporaryDirectory() as folder:
            trainers = [Trainer(config, Path(folder) / str(k), args.device) for k, config in enumerate(configs)]
            for epoch in range(args.epochs + WARM_UP):
                for trainer, own in zip(trainers, times, strict=True):
                    # Not the sum of its parts, which overlap; the critic's fit belongs to the epoch that began it.
                    finish(args.device)
                    started = time.perf_counter()
                    row = trainer.run_epoch()
                    finish(args.device)
                    if epoch >= WARM_UP:
                        own.append(time.perf_counter() - started)
            for trainer in trainers:
                trainer.close()
        steps = row["train/horizon"] * worlds
        plain, drawn = (statistics.median(own) for own in times)
        speeds = [f"{steps / seconds:,.0f}" for seconds in (plain, drawn)]
        rows.append([str(worlds), f"{steps:.0f}", *speeds, f"{plain / drawn:.3f}"])
        print(rows[-1], flush=True)
    title = f"SHAC epochs, {configs[0].env.name}, with {configs[1].physics.randomize} and without"
    header = ["worlds", "env steps an epoch", "env steps/s without", "with", "ratio"]
    publish("randomize", title, args.device, markdown_table(header, rows), args.results)


if __name__ == "__main__":
    main()
