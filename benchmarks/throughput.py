"""Throughput of every trial of some experiments, relative to the first experiment's: what neighbours cost."""

import argparse
import json
import statistics
from pathlib import Path

from record import RESULTS, markdown_table, publish

from msk_ray.training import read_metrics

_WARM_UP = 5
"""First epochs of a trial, left out."""


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("experiments", nargs="+", type=Path, metavar="EXPERIMENT", help="folders; the lone trial's first")
    p.add_argument("--device", default="cuda:0")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    rows, lone = [], None
    for experiment in args.experiments:
        for folder in sorted((experiment / "trials").iterdir()):
            epochs = read_metrics(folder / "metrics.jsonl")[_WARM_UP:]
            speed = statistics.median(row["env_steps_per_s"] for row in epochs)
            lone = lone or speed
            device = json.loads((folder / "device.json").read_text())
            rows.append(
                [
                    experiment.name,
                    folder.name,
                    device["visible"],
                    str(device["count"]),
                    f"{speed:,.0f}",
                    f"{speed / lone:.3f}",
                ]
            )
    header = ["experiment", "trial", "CUDA_VISIBLE_DEVICES", "GPUs seen", "env steps/s", "of lone"]
    publish("throughput", "Trials beside each other", args.device, markdown_table(header, rows), args.results)


if __name__ == "__main__":
    main()
