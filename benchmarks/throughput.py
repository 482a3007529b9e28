"""What trials cost each other: one alone, eight with a GPU each, and four that share one GPU.

Three sweeps of `python -m msk_ray.tune` over the same config with different seeds, each trial trained for the same
time. A trial's speed is the median of its epochs, the first few left out. About four minutes on four GPUs, a minute of
it compilation where Warp's cache is cold. With --cpu, to see that it works: two sweeps, a core for each trial.

The table says whether processes share a GPU through Nvidia's MPS, which runs their kernels at the same time. Without
it they take turns. `nvidia-cuda-mps-control -d` starts it, `echo quit | nvidia-cuda-mps-control` ends it.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from record import RESULTS, markdown_table, publish

import msk_ray
from msk_ray.config import dump_yaml, parse_overrides
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.outcomes import read_ending
from msk_ray.tune.devices import local_gpus

REPOSITORY = Path(msk_ray.__file__).resolve().parent.parent
WARM_UP = 5
"""First epochs of a trial, left out."""
SHARING = 4
"""Trials on one GPU."""


@dataclass(frozen=True)
class Speed:
    """How fast one trial was, and where."""

    sweep: str
    trial: str
    visible: str
    """CUDA_VISIBLE_DEVICES in its process."""
    count: int
    """GPUs its process saw."""
    env_steps_per_s: float


def space(config: Path, seeds: int, seconds: float, overrides: dict[str, object]) -> dict[str, object]:
    """A space of `seeds` seeds, each trained for `seconds`, with almost no evaluation and no checkpoints."""
    quiet: dict[str, object] = {
        "trial.epochs": 1_000_000,
        "execution.checkpoint_interval": 1_000_000,
        "evaluation.interval": 20,
        "evaluation.nworld": 1,
        "evaluation.steps": 1,
    }
    return {
        "question": "What do trials cost each other?",
        "base": str(config.resolve()),
        "overrides": quiet | overrides,
        "seeds": f"0-{seeds - 1}",
        "stop": {"wall_time_s": seconds},
    }


def read_speeds(experiment: Path) -> list[Speed]:
    """Speeds of the trials of an experiment, in the order of their ids.

    Raises:
        SystemExit: a trial did not train until its time was up, or not for long enough.
    """
    found = []
    for folder in sorted((experiment / "trials").iterdir()):
        ending = read_ending(folder)
        rows = [row for row in read_rows(folder) if row["epoch"] > WARM_UP]
        if ending is None or ending.outcome != "wall_time" or not rows:
            sys.exit(f"{folder}: ended {ending} after {len(rows) + WARM_UP} epochs; see its output.log")
        device = json.loads((folder / "device.json").read_text())
        speed = statistics.median(row["env_steps_per_s"] for row in rows)
        found.append(Speed(experiment.name, folder.name, device["visible"], device["count"], speed))
    return found


def summary(alone: list[Speed], apart: list[Speed], sharing: list[Speed]) -> list[str]:
    """What the speeds say, a line each."""
    lone = alone[0].env_steps_per_s
    shares = [speed.env_steps_per_s / lone for speed in apart]
    lines = [
        f"{len(apart)} trials, a device each: {min(shares):.3f} to {max(shares):.3f} of a lone trial, "
        f"median {statistics.median(shares):.3f}"
    ]
    if sharing:
        total = sum(speed.env_steps_per_s for speed in sharing)
        lines.append(
            f"{len(sharing)} trials on one GPU: {total:,.0f} env steps/s together, {total / lone:.2f} of a lone one"
        )
    wrong = [speed for speed in (*alone, *apart, *sharing) if speed.visible and speed.count != 1]
    lines += [f"trial {speed.trial} saw {speed.count} GPUs instead of one" for speed in wrong]
    return lines


def run(
    folder: Path, name: str, data: dict[str, object], options: list[str], visible: str | None = None
) -> list[Speed]:
    """One sweep; its trials' speeds."""
    path = folder / f"{name}.yaml"
    path.write_text(dump_yaml(data))
    command = [sys.executable, "-m", "msk_ray.tune", "--space", str(path), "--name", name, "--storage", str(folder)]
    paths = [str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    if visible is not None:
        environment["CUDA_VISIBLE_DEVICES"] = visible
    environment.pop("RAY_ADDRESS", None)
    code = subprocess.run([*command, *options], env=environment).returncode
    if code:
        sys.exit(f"the sweep {name!r} ended with exit code {code}")
    return read_speeds(folder / name)


def mps_runs() -> bool:
    """Whether a control daemon of Nvidia's MPS answers."""
    program = shutil.which("nvidia-cuda-mps-control")
    if program is None:
        return False
    return subprocess.run([program], input="get_server_list\n", text=True, capture_output=True).returncode == 0


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--config", type=Path, default=REPOSITORY / "configs" / "ant.yaml")
    p.add_argument("--worlds", type=int, default=1024)
    p.add_argument("--trials", type=int, default=8, help="of the second sweep")
    p.add_argument("--seconds", type=float, default=15.0, help="each trial trains for")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    p.add_argument("--cpu", action="store_true")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args(argv)
    if not args.cpu and local_gpus() == 0:
        sys.exit("no GPU here: pass --cpu, with a small --config")
    overrides = {"env.nworld": args.worlds} | parse_overrides(args.overrides)
    device = ["--cpu"] if args.cpu else []
    with tempfile.TemporaryDirectory(prefix="thr_") as scratch:
        folder = Path(scratch)
        one, many, four = (space(args.config, n, args.seconds, overrides) for n in (1, args.trials, SHARING))
        alone = run(folder, "alone", one, device)
        apart = run(folder, "apart", many, device)
        # The lone trial's GPU is the first: on it alone, four at once.
        first = os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0]
        sharing = [] if args.cpu else run(folder, "sharing", four, ["--gpus-per-trial", f"{1 / SHARING}"], first)
    lone = alone[0].env_steps_per_s
    rows = [
        [s.sweep, s.trial, s.visible, f"{s.count}", f"{s.env_steps_per_s:,.0f}", f"{s.env_steps_per_s / lone:.3f}"]
        for s in (*alone, *apart, *sharing)
    ]
    header = ["sweep", "trial", "CUDA_VISIBLE_DEVICES", "GPUs seen", "env steps/s", "of lone"]
    title = f"Trials beside each other, {args.config.stem}, {args.worlds} worlds{', through MPS' if mps_runs() else ''}"
    text = "\n".join([markdown_table(header, rows), "", *(f"- {line}" for line in summary(alone, apart, sharing))])
    publish("throughput", title, "cpu" if args.cpu else "cuda:0", text, args.results)


if __name__ == "__main__":
    main()
