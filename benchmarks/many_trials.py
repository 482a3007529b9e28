"""What a sweep of thousands of trials costs its driver, its files and those who read them, on a CPU.

    python benchmarks/many_trials.py                            # 2000 trials of 20 rows, a process each
    python benchmarks/many_trials.py --reuse --limit 1300       # in four processes; stopped after 1300 s
    python benchmarks/many_trials.py --trials 200 --rows 2 20   # two sweeps: what a start costs, and what a report

`python -m msk_ray.tune` with its own driver, Ray and dashboard, where each trial is a process that writes rows and
reports them without training. Then `status`, `report`, the dashboard's page and a `--resume` that finds all ended.
"""

import argparse
import functools
import json
import math
import os
import random
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Collection
from pathlib import Path

from fault_campaign.processes import descendants_of, name_of, stat_of
from record import RESULTS, markdown_table, publish

from msk_ray.config import Config, dump_yaml
from msk_ray.files import append_text, write_json
from msk_ray.signals import RESUMABLE

REPOSITORY = Path(__file__).resolve().parents[1]
SAMPLE_S = 5.0
"""Interval at which the driver's processes are looked at [s]."""
TIMES_FILE = "times.json"
"""In a trial's folder: when it began and ended [s since the epoch], and how long each report took [s]."""


class StubTrainer:
    """In place of `msk_ray.training.Trainer`: epochs that take no time, each with an evaluation."""

    def __init__(self, config: Config, logdir: Path, device: str) -> None:
        self.config, self.logdir = config, logdir
        self.epoch, self.best_score = 0, -math.inf
        self._rng = random.Random(logdir.name)
        self._began, self._left, self._reports = time.time(), 0.0, []  # type: ignore[var-annotated]
        (logdir / "checkpoints").mkdir(exist_ok=True)
        (logdir / "config.yaml").write_text(dump_yaml(config.as_dict()))
        self._write()

    @property
    def finished(self) -> bool:
        return self.epoch >= self.config.trial.epochs

    def run_epoch(self) -> dict[str, float]:
        self._note()
        self.epoch += 1
        row = self._write()
        self._left = time.perf_counter()
        return row

    def _note(self) -> None:
        """Everything between two epochs is the report to the driver."""
        if self._left:
            self._reports.append(time.perf_counter() - self._left)

    def _write(self) -> dict[str, float]:
        score = 100.0 * self.epoch + self._rng.gauss(0, 50)
        self.best_score = max(self.best_score, score)
        row = {"epoch": self.epoch, "env_steps": 1000 * self.epoch, "seconds": 1.0 * self.epoch, "env_steps_per_s": 1e3}
        row |= {f"train/figure_{number}": self._rng.random() for number in range(24)}
        row |= {"eval/score": score, "eval/best_score": self.best_score}
        append_text(self.logdir / "metrics.jsonl", json.dumps(row) + "\n")
        return row

    def save(self) -> Path:
        path = self.logdir / "checkpoints" / f"epoch_{self.epoch:06d}.pt"
        path.touch()
        return path

    def discard_checkpoint(self) -> None: ...

    def restore(self, path: Path, changed: Collection[str]) -> None: ...

    def restore_latest(self) -> tuple[Path | None, list[str]]:
        return None, []

    def close(self) -> None:
        self._note()
        (self.logdir / TIMES_FILE).write_text(json.dumps([self._began, time.time(), self._reports]))


def drive(concurrent: int, reuse: bool, arguments: list[str]) -> int:
    """`python -m msk_ray.tune` with such trials, as many at a time as asked for, whatever the machine has."""
    from msk_ray.cli import run
    from msk_ray.tune import driver, session
    from msk_ray.tune.__main__ import main as tune_main

    start, no_torch = session.start_local, session.ray_session
    session.start_local = lambda dashboard, options: start(dashboard, {**options, "num_cpus": concurrent})
    session.ray_session = functools.partial(no_torch, trials=False)
    driver.Plan = functools.partial(  # type: ignore[assignment,misc]
        driver.Plan, make_trainer=StubTrainer, precompile=None, prestart=False
    )
    if reuse:
        config = driver.tune.TuneConfig
        driver.tune.TuneConfig = lambda **given: config(**{**given, "reuse_actors": True})
    return run(tune_main, arguments)


class Usage:
    """CPU time and memory of a process and of its descendants by name, while it runs."""

    def __init__(self, process: "subprocess.Popen[bytes]", ended: Path) -> None:
        """
        Args:
            process: the driver.
            ended: the folder whose folders' outcomes say how far it is.
        """
        self._process = process
        self._ended = ended
        self.samples: list[tuple[float, int, float, float]] = []
        """Seconds, trials that have ended, the driver's CPU seconds, its memory [MB]."""
        self._of: dict[int, tuple[str, float]] = {}
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    def _follow(self) -> None:
        started = time.monotonic()
        while self._process.poll() is None:
            ended = sum((folder / "outcome.json").exists() for folder in self._ended.glob("*"))
            stat = stat_of(self._process.pid)
            if stat:
                memory = int(stat[22]) * resource.getpagesize() / 1e6
                self.samples.append((time.monotonic() - started, ended, _cpu(stat), memory))
            for pid in descendants_of(self._process.pid):
                if stat := stat_of(pid):
                    self._of[pid] = name_of(pid), _cpu(stat)
            time.sleep(SAMPLE_S)

    def of_daemons(self) -> Counter[str]:
        """CPU seconds by the name of the process."""
        found: Counter[str] = Counter()
        for name, seconds in self._of.values():
            found["ray::" if name.startswith("ray::") else name] += seconds  # type: ignore[assignment]
        return found

    def at(self, share: float) -> tuple[float, int, float, float]:
        """The first sample with this share of the trials ended."""
        most = self.samples[-1][1]
        return next(sample for sample in self.samples if sample[1] >= share * most)


def _cpu(stat: list[str]) -> float:
    return (int(stat[12]) + int(stat[13])) / os.sysconf("SC_CLK_TCK")


def timed(*arguments: str, environment: dict[str, str]) -> tuple[float, float, float]:
    """Seconds that a command takes, those on a CPU, and its peak memory [MB]."""
    started = time.monotonic()
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"exit code {process.returncode}: {' '.join(arguments)}")
    return time.monotonic() - started, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


DASHBOARD = """
import sys, time
from pathlib import Path
from msk_ray.dashboard.library import Library
library = Library(Path(sys.argv[1]), 0.0, False, None)
library.index(), library.page(["many"])
"""


def sizes(experiment: Path) -> dict[str, tuple[int, float]]:
    """Number of files, and their sum [MB], by folder of the experiment."""
    found: dict[str, tuple[int, float]] = {}
    for path in experiment.rglob("*"):
        if path.is_file():
            inside = path.relative_to(experiment).parts
            kind = inside[0] if len(inside) < 3 or inside[0] != "trials" else "trials"
            count, size = found.get(kind, (0, 0.0))
            found[kind] = count + 1, size + path.stat().st_size / 1e6
    return found


def measure(
    trials: int, rows: int, concurrent: int, reuse: bool, limit: float | None, scratch: Path
) -> list[tuple[str, str]]:
    """One sweep, and its figures by name."""
    space = {
        "question": "What do thousands of trials cost?",
        "base": str(REPOSITORY / "configs" / "ant.yaml"),
        "overrides": {"trial.epochs": rows, "evaluation.interval": 1, "execution.checkpoint_interval": rows},
        "parameters": {"shac.actor_lr": {"loguniform": [1e-4, 1e-2]}, "shac.gamma": {"uniform": [0.95, 0.999]}},
        "samples": trials,
        "max_trials": trials,
    }
    (scratch / "space.yaml").write_text(dump_yaml(space))
    paths = [str(REPOSITORY), str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "RAY_TMPDIR": str(scratch)}
    options = ["--space", str(scratch / "space.yaml"), "--name", "many", "--storage", str(scratch / "runs"), "--cpu"]
    program = [__file__, "drive", str(concurrent), "reuse" if reuse else "new", *options]
    experiment, log = scratch / "runs" / "many", scratch / "driver.log"
    load, started = os.getloadavg()[0], time.monotonic()
    with log.open("wb") as file:
        driver = subprocess.Popen([sys.executable, *program], stdout=file, stderr=file, env=environment)
        usage = Usage(driver, experiment / "trials")
        try:
            code = driver.wait(limit)
        except subprocess.TimeoutExpired:
            driver.terminate()
            code = driver.wait()
    wall = time.monotonic() - started
    if code not in (0, RESUMABLE):
        sys.exit(log.read_text(errors="replace")[-3000:])
    if not list(experiment.glob(f"trials/*/{TIMES_FILE}")):
        sys.exit(f"no trial has ended within {limit:.0f} s:\n{log.read_text(errors='replace')[-3000:]}")
    times = [json.loads(path.read_text()) for path in experiment.glob(f"trials/*/{TIMES_FILE}")]
    reports = sorted(seconds for _, _, own in times for seconds in own)
    first, half, last = usage.at(0.02), usage.at(0.5), usage.at(1.0)
    halves = [1e3 * (b[2] - a[2]) / max(1, b[1] - a[1]) for a, b in ((first, half), (half, last))]
    begun = sorted(began for began, _, _ in times)
    figures = {
        "trials, of them ended": f"{trials}, {len(times)}",
        "rows of a trial, trials at a time": f"{rows}, {concurrent}{' in processes used again' if reuse else ''}",
        "load before, and at the end": f"{load:.1f}, {os.getloadavg()[0]:.1f}",
        "wall [s]": f"{wall:.0f}",
        "trials started a second": f"{len(begun) / (begun[-1] - begun[0]):.2f}",
        "driver's CPU [s], all of it": f"{usage.samples[-1][2]:.0f}",
        "of it before the first trial has ended": f"{first[2]:.1f}",
        "driver's CPU a trial [ms], first and second half": f"{halves[0]:.0f}, {halves[1]:.0f}",
        "driver's memory [MB], first, half, end": ", ".join(f"{sample[3]:.0f}" for sample in (first, half, last)),
        "a report, from a trial to its next epoch [ms], median, 99 %": ", ".join(
            f"{1e3 * reports[int(share * (len(reports) - 1))]:.0f}" for share in (0.5, 0.99)
        ),
        "a trial, from its first epoch to its last [s], median": f"{statistics.median(b - a for a, b, _ in times):.2f}",
        "CPU [s] of Ray's processes": ", ".join(f"{n} {s:.0f}" for n, s in usage.of_daemons().most_common(6)),
    }
    figures |= {
        f"files: {kind}": f"{count}, {size:.1f} MB"
        for kind, (count, size) in sorted(sizes(experiment).items(), key=lambda item: -item[1][1])[:6]
    }
    readers = {
        "status": ["-m", "msk_ray.status", str(experiment)],
        "report": ["-m", "msk_ray.report", str(experiment), "--best", "never"],
        "dashboard, list and page": ["-c", DASHBOARD, str(scratch / "runs")],
    }
    if code == 0:
        readers["tune --resume, all ended"] = [*program, "--resume"]
    for name, arguments in readers.items():
        seconds, cpu, memory = timed(*arguments, environment=environment)
        figures[f"{name} [s], CPU [s], memory [MB]"] = f"{seconds:.1f}, {cpu:.1f}, {memory:.0f}"
    write_json(scratch / "samples.json", usage.samples)
    return list(figures.items())


def main() -> None:
    """Run the benchmark the command line asks for."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--trials", type=int, default=2000)
    p.add_argument("--rows", type=int, nargs="+", default=[20], help="of a trial; a sweep for each number")
    p.add_argument("--concurrent", type=int, default=4, help="trials at a time")
    p.add_argument(
        "--reuse", action="store_true", help="let trials follow each other in a process, which saves seconds"
    )
    p.add_argument("--limit", type=float, help="seconds after which a sweep is stopped")
    p.add_argument("--keep", type=Path, help="folder, with a short path, that keeps the experiment of one sweep")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    columns = []
    for rows in args.rows:
        with tempfile.TemporaryDirectory(prefix="many_", dir="/tmp") as scratch:  # Ray's sockets need a short path
            columns.append(
                measure(args.trials, rows, args.concurrent, args.reuse, args.limit, args.keep or Path(scratch))
            )
    table = [[name, *(dict(column)[name] for column in columns)] for name, _ in columns[0]]
    header = ["figure", *(f"{rows} rows" for rows in args.rows)]
    title = f"A sweep of {args.trials} trials that do not train"
    publish("many_trials", title, "cpu", markdown_table(header, table), args.results)


if __name__ == "__main__":
    if sys.argv[1:2] == ["drive"]:
        sys.exit(drive(int(sys.argv[2]), sys.argv[3] == "reuse", sys.argv[4:]))
    main()
