"""Whether a trial repeats itself, bit for bit: twice, on another GPU, killed and resumed, and beside others under tune.

    python lab/benchmarks/repeat.py --configs cartpole ant ant_hard_friction ant_published myoleg26
    python lab/benchmarks/repeat.py --devices cuda:0 cuda:1 --tune ant

Each config is trained with `execution.deterministic` by processes of their own: once on the first device, again on the
last, and once more by a process that is killed with SIGKILL halfway and by another that resumes it. For `--tune`, a
space of four seeds runs on one GPU at once, and its trial of seed 0 is compared with the first run. Compared are the
hashes of all weights and statistics at every evaluation, and those in the last checkpoint.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path

from record import RESULTS, markdown_table, publish

from msk_ray.config import read_yaml
from msk_ray.experiment.checkpoint_format import read_facts
from msk_ray.experiment.metrics import read_rows

POLL = 0.05
"""Between looks at how far a trial is [s]."""
EQUAL = "all equal"


def main() -> int:
    """Run the benchmark the command line asks for; 1 if a run differs from the first."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--configs", nargs="+", default=["cartpole"], metavar="NAME|FILE")
    p.add_argument("--epochs", type=int, default=100)
    p.add_argument("--interval", type=int, default=10, help="epochs between evaluations, and between checkpoints")
    p.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    p.add_argument("--devices", nargs="+", default=["cpu"], help="of the first run, the second, ...; the last is kept")
    p.add_argument("--tune", nargs="*", default=[], metavar="NAME|FILE", help="configs to run under tune as well")
    p.add_argument("--jobs", type=int, default=3, help="runs at a time")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(args.jobs) as pool:
        folder = Path(name)
        runs: dict[str, dict[str, Callable[[], list[str]]]] = {config: {} for config in args.configs}
        for config, own in runs.items():
            run = Run(config, folder / Path(config).stem, args)
            own["first"] = partial(run.whole, "first", args.devices[0])
            own[f"second, {args.devices[-1]}"] = partial(run.whole, "second", args.devices[-1])
            own["killed and resumed"] = partial(run.killed, args.devices[0])
            if config in args.tune:
                own["one of four under tune"] = partial(run.under_tune, args.devices[0])
        pending = {config: {label: pool.submit(own) for label, own in of.items()} for config, of in runs.items()}
        rows = []
        for config, of in pending.items():
            first = outcome(of.pop("first"))
            for label, future in of.items():
                rows.append([Path(config).stem, f"{args.epochs}", label, *compared(first, outcome(future))])
                print(rows[-1], flush=True)
    header = ["config", "epochs", "run", "hashes", "compared with the first run"]
    publish("repeat", "Runs that repeat", args.devices[0], markdown_table(header, rows), args.results)
    return 0 if all(row[-1] == EQUAL for row in rows) else 1


def outcome(run: Future[list[str]]) -> list[str] | RuntimeError:
    """A run's hashes, or the command that failed with what it printed."""
    try:
        return run.result()
    except RuntimeError as error:
        print(error, flush=True)
        return error


def compared(first: list[str] | RuntimeError, other: list[str] | RuntimeError) -> tuple[str, str]:
    """How many hashes there are, and at which they first differ."""
    if isinstance(first, RuntimeError) or isinstance(other, RuntimeError):
        return "-", f"{'first' if isinstance(first, RuntimeError) else 'this'} run failed"
    if len(first) != len(other):
        return f"{len(first)}", f"{len(other)} hashes"
    differing = [number for number, (one, two) in enumerate(zip(first, other, strict=True), 1) if one != two]
    return f"{len(first)}", f"differ from number {differing[0]} on" if differing else EQUAL


class Run:
    """One config's runs, below a folder."""

    def __init__(self, config: str, folder: Path, args: argparse.Namespace) -> None:
        self._config, self._folder, self._epochs = config, folder, args.epochs
        # Run from the config's folder, where an environment from outside is found.
        self._base = (Path(config) if Path(config).suffix else Path("configs") / f"{config}.yaml").resolve()
        self._settings = ["execution.deterministic=true", f"trial.epochs={args.epochs}", *args.overrides]
        self._settings += [f"{key}={args.interval}" for key in ("evaluation.interval", "execution.checkpoint_interval")]

    def whole(self, name: str, device: str) -> list[str]:
        """Hashes of a run in one go."""
        self._finish(self._command(name, device), name)
        return hashes(self._folder / name)

    def killed(self, device: str) -> list[str]:
        """Hashes of a run that was killed halfway."""
        name, command = "killed", self._command("killed", device)
        rows = self._folder / name / "metrics.jsonl"
        with self._log(name).open("w") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self._base.parent)
            while not rows.exists() or rows.read_text().count("\n") < self._epochs // 2:
                if process.poll() is not None:
                    raise RuntimeError(f"{self._config} ended before it was killed:\n{self._log(name).read_text()}")
                time.sleep(POLL)
            process.send_signal(signal.SIGKILL)
            process.wait()
        self._finish([*command, "--resume"], "resumed")
        return hashes(self._folder / name)

    def under_tune(self, device: str) -> list[str]:
        """Hashes of seed 0 of a space of four seeds."""
        space = self._folder / "four.yaml"
        space.parent.mkdir(exist_ok=True)
        question = "Does a trial beside three others repeat the lone run?"
        known = {"question": question, "base": str(self._base), "seeds": "0-3", "scheduler": {"kind": "none"}}
        space.write_text(json.dumps(known))
        sets = [word for setting in self._settings for word in ("--set", setting)]
        share = ["--cpu", "--max-concurrent", "4"] if device == "cpu" else ["--gpus-per-trial", "0.25"]
        command = [sys.executable, "-m", "msk_ray.tune", "--space", str(space), "--storage", str(self._folder), *sets]
        self._finish([*command, *share], "tune", CUDA_VISIBLE_DEVICES=device.removeprefix("cuda:"))
        trials = self._folder / "four" / "trials"
        (seed0,) = (path for path in trials.iterdir() if read_yaml(path / "config.yaml")["trial"]["seed"] == 0)
        return hashes(seed0)

    def _command(self, name: str, device: str) -> list[str]:
        sets = [word for setting in self._settings for word in ("--set", setting)]
        start = [sys.executable, "-m", "msk_ray.train", "--config", str(self._base), "--device", device]
        return [*start, "--logdir", str(self._folder / name), *sets]

    def _log(self, name: str) -> Path:
        self._folder.mkdir(exist_ok=True)
        return self._folder / f"{name}.log"

    def _finish(self, command: list[str], name: str, **variables: str) -> None:
        """Run a command to its end, in the folder of its config."""
        with self._log(name).open("w") as log:
            run = subprocess.run(
                command, stdout=log, stderr=log, cwd=self._base.parent, env={**os.environ, **variables}
            )
        if run.returncode:
            raise RuntimeError(f"{' '.join(command)} ended with {run.returncode}:\n{self._log(name).read_text()}")


def hashes(trial: Path) -> list[str]:
    """Those of the evaluations, and the last checkpoint's."""
    found = [f"{row['hash/parameters']:.0f}" for row in read_rows(trial) if "hash/parameters" in row]
    last = max((trial / "checkpoints").glob("epoch_*.pt"))
    return [*found, str(read_facts(last)["parameters"])]


if __name__ == "__main__":
    sys.exit(main())
