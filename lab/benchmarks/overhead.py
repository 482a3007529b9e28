"""The overhead of Ray Tune: a sweep of real trials, one after another, against the same trials by `msk_ray.train` in a
loop.

The median epoch of every trial under Tune relative to that in the loop, which is run before and after it, so that a
machine that grows slower or faster cancels out and shows how far it can be trusted. The time a trial spends between its
epochs, which neighbours on the machine touch less (what it pays while it trains). The time from the end of a trial to
the first epoch of the next one (what it pays between trials; kernels are in Warp's cache from the loop, which ran
first). The wall time of everything, start-up included.
"""

import argparse
import functools
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from record import RESULTS, markdown_table, publish

import msk_ray
from msk_ray.config import dump_yaml
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.trial import Trial
from msk_ray.sweep.space import load_space
from msk_ray.sweep.trials import resolve_trials
from msk_ray.training import Trainer
from msk_ray.tune import driver

REPOSITORY = Path(msk_ray.__file__).resolve().parent.parent
WARM_UP = 5
"""First epochs of a trial, left out: caches fill and graphs are recorded."""
TIMES_FILE = "times.json"


class TimedTrainer(Trainer):
    """Leaves in the trial's folder when its first epoch began and when it ended [s since the epoch], and the time
    between its epochs (reports, gauges, watchdog) as a share of that in them."""

    _begun: float | None = None
    _inside = _between = 0.0
    _left: float | None = None

    def run_epoch(self) -> dict[str, float]:
        entered = time.monotonic()
        if self._begun is None:
            self._begun = time.time()
        if self._left is not None:
            self._between += entered - self._left
        row = super().run_epoch()
        self._left = time.monotonic()
        self._inside += self._left - entered
        return row

    def close(self) -> None:
        super().close()
        share = self._between / self._inside
        times = {"begun": self._begun, "ended": time.time(), "between_share": share}
        (self.logdir / TIMES_FILE).write_text(json.dumps(times))


def drive(arguments: list[str]) -> int:
    """`python -m msk_ray.tune` whose trials note when they begin and end."""
    from msk_ray.cli import run
    from msk_ray.tune.__main__ import main as tune_main

    driver.Plan = functools.partial(driver.Plan, make_trainer=TimedTrainer)  # type: ignore[assignment,misc]
    return run(tune_main, arguments)


def epoch_seconds(folder: Path) -> float:
    """Median time of an epoch without evaluation [s]."""
    rows = read_rows(folder)[WARM_UP:]
    gaps = [b["seconds"] - a["seconds"] for a, b in itertools.pairwise(rows) if "eval/score" not in b]
    return statistics.median(gaps)


def turnarounds(folders: list[Path]) -> list[float]:
    """Seconds from the end of each trial to the first epoch of the one after it."""
    times = sorted((json.loads((folder / TIMES_FILE).read_text()) for folder in folders), key=lambda t: t["begun"])
    return [b["begun"] - a["ended"] for a, b in itertools.pairwise(times)]


def _run(command: list[str], log: Path) -> float:
    paths = [str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    started = time.monotonic()
    with log.open("a") as file:
        code = subprocess.run(command, stdout=file, stderr=file, env=environment).returncode
    if code:
        sys.exit(f"exit code {code}; see {log}:\n{log.read_text()[-2000:]}")
    return time.monotonic() - started


def loop(trials: list[Trial], folder: Path, device: str) -> float:
    """Every trial by `msk_ray.train`, a process each; seconds in all."""
    total = 0.0
    for trial in trials:
        path = folder / trial.id
        path.mkdir(parents=True)
        config = folder / f"{trial.id}.yaml"
        config.write_text(dump_yaml(trial.config.as_dict()))
        command = [sys.executable, "-m", "msk_ray.train", "--config", str(config), "--logdir", str(path)]
        total += _run([*command, "--device", device], folder / "loop.log")
    return total


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--trials", type=int, default=5)
    p.add_argument("--config", default="configs/cartpole.yaml")
    p.add_argument("--epochs", type=int, default=100)
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    p.add_argument("--device", default="cpu", choices=("cpu", "cuda:0"))
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    with tempfile.TemporaryDirectory(prefix="over_", dir="/tmp") as scratch:
        folder = Path(scratch)
        space = {
            "question": "What does Tune cost?",
            "base": str(Path(args.config).resolve()),
            "overrides": {"trial.epochs": args.epochs} | _parsed(args.overrides),
            "seeds": f"0-{args.trials - 1}",
        }
        (folder / "space.yaml").write_text(dump_yaml(space))
        trials = resolve_trials(load_space(folder / "space.yaml"))
        before, after = folder / "before", folder / "after"
        by_loop = loop(trials, before, args.device)
        command = [sys.executable, __file__, "drive", "--space", str(folder / "space.yaml"), "--name", "tune"]
        command += ["--storage", str(folder), "--max-concurrent", "1", *(["--cpu"] if args.device == "cpu" else [])]
        by_tune = _run(command, folder / "tune.log")
        tuned = [folder / "tune" / "trials" / trial.id for trial in trials]
        by_loop = (by_loop + loop(trials, after, args.device)) / 2
        looped = [(epoch_seconds(before / trial.id), epoch_seconds(after / trial.id)) for trial in trials]
        ratios = [epoch_seconds(a) / statistics.mean(b) for a, b in zip(tuned, looped, strict=True)]
        between = turnarounds(tuned)
        epochs = [epoch_seconds(path) for path in tuned]
        shares = [100 * json.loads((path / TIMES_FILE).read_text())["between_share"] for path in tuned]
        text = (folder / "tune.log").read_text()
    header = ["figure", "median", "least", "most"]
    rows = [
        ["epoch under Tune / in the loop", *_spread(ratios, ".3f")],
        ["epoch in the loop, afterwards / before", *_spread([b / a for a, b in looped], ".3f")],
        ["epoch under Tune [ms]", *_spread([1e3 * e for e in epochs], ".1f")],
        ["time between epochs, of that in them [%]", *_spread(shares, ".2f")],
        ["end of a trial to first epoch of the next [s]", *_spread(between, ".2f")],
        ["wall time under Tune / in the loop", f"{by_tune / by_loop:.3f}", f"{by_tune:.0f} s", f"{by_loop:.0f} s"],
    ]
    if "finished" not in text:
        sys.exit(text)
    title = (
        f"Overhead of Tune, {args.trials} trials of {args.epochs} epochs one after another, {Path(args.config).stem}"
    )
    publish("overhead", title, args.device, markdown_table(header, rows), args.results)


def _parsed(overrides: list[str]) -> dict[str, object]:
    from msk_ray.config import parse_overrides

    return parse_overrides(overrides)


def _spread(values: list[float], form: str) -> list[str]:
    return [f"{value:{form}}" for value in (statistics.median(values), min(values), max(values))]


if __name__ == "__main__":
    sys.exit(drive(sys.argv[2:]) if sys.argv[1:2] == ["drive"] else main())
