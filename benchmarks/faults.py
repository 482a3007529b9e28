"""What a sweep survives: CartPole trials under Ray Tune, shot at with a fixed seed, compared with trials left alone.

The reference is `Trainer` in a loop, without Ray. After its faults, every sweep is brought to its end by `--resume` (or
by nothing, where none is needed). Then every trial must have finished, each row of the reference be there once on
reading, with equal values (timings left out), and the last checkpoint hold equal tensors.

Faults inside a trial's process strike at a chosen epoch and once each (`FaultyTrainer`); those from outside (driver,
raylet, files, disk) when the trials have written a number of rows drawn from the seed.
"""

import argparse
import contextlib
import functools
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from record import RESULTS, markdown_table, publish

import msk_ray
from msk_ray.config import dump_yaml
from msk_ray.training import Trainer, read_checkpoint
from msk_ray.tune.outcomes import read_ending
from msk_ray.tune.records import read_rows
from msk_ray.tune.space import load_space
from msk_ray.tune.trials import Trial, resolve_trials

REPOSITORY = Path(msk_ray.__file__).resolve().parent.parent
EPOCHS = 40
SPACE = {
    "question": "What does a sweep survive?",
    "base": "configs/cartpole.yaml",
    "overrides": {
        "env.nworld": 8,
        "shac.horizon": 8,
        "evaluation.nworld": 8,
        "evaluation.steps": 32,
        "evaluation.interval": 2,
        "trial.epochs": EPOCHS,
        "trial.checkpoint_interval": 2,
    },
    "parameters": {"shac.actor_lr": {"grid": [5.0e-3, 1.0e-3]}},
    "seeds": "0-1",
    "resources": {"max_failures": 20, "hang_s": 20.0},
}
"""Four trials of forty epochs, checkpointed every second one."""
TIMING = ("seconds", "env_steps_per_s", "time/")
DISK_MIB = 48
RESUMABLE = 75
LAUNCH_LIMIT_S = 900.0


class FaultyTrainer(Trainer):
    """A trainer that does to its own process what it finds in `EXPERIMENT/faults/TRIAL/EPOCH`, once each."""

    def _take(self) -> str | None:
        path = self.logdir.parent.parent / "faults" / self.logdir.name / str(self.epoch + 1)
        if not path.is_file():
            return None
        kind = path.read_text()
        path.rename(path.with_suffix(".done"))
        return kind

    def run_epoch(self) -> dict[str, float]:
        kind = self._take()
        match kind:
            case "kill":
                _kill_self()
            case "hang":
                time.sleep(3600)
            case "nan":
                next(self.shac.actor.parameters()).data.fill_(math.nan)
        row = super().run_epoch()
        match kind:
            case "torn_row":
                with (self.logdir / "metrics.jsonl").open("a") as file:
                    file.write(json.dumps({"epoch": self.epoch + 1, "env_steps": 1})[:17])
                _kill_self()
            case "torn_checkpoint":
                # What lies there after a death between a checkpoint's two files, on a disk that lost half of it.
                path = self.save()
                path.with_suffix(".json").unlink()
                os.truncate(path, path.stat().st_size // 2)
                _kill_self()
        return row


def _kill_self() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def drive(arguments: list[str]) -> int:
    """`python -m msk_ray.tune` with trials that can be shot at, and without the dashboard's share of the cores."""
    from msk_ray.cli import run
    from msk_ray.tune import runner
    from msk_ray.tune.__main__ import main as tune_main

    runner.Plan = functools.partial(runner.Plan, trainer_class=FaultyTrainer)  # type: ignore[assignment,misc]
    runner.ray_session = functools.partial(runner.ray_session, dashboard=False)
    return run(tune_main, arguments)


@dataclass
class Tally:
    """One line of the table."""

    fault: str
    injected: int
    ended_by: str
    lost_rows: int = 0
    lost_trials: int = 0
    seconds: float = 0.0
    notes: list[str] = field(default_factory=list)

    @property
    def survived(self) -> int:
        return 0 if self.lost_rows or self.lost_trials else self.injected


class Reference:
    """Every trial of the space, trained without Ray and without faults."""

    def __init__(self, trials: list[Trial], folder: Path) -> None:
        import torch

        torch.set_num_threads(1)  # what a trial of one core gets
        self.trials = trials
        self._folder = folder
        for trial in trials:
            trainer = Trainer(trial.config, folder / trial.id, "cpu")
            while not trainer.finished:
                trainer.run_epoch()
            trainer.close()

    def compare(self, experiment: Path, trials: list[Trial]) -> tuple[int, int, list[str]]:
        """Rows and trials of an experiment that are missing or differ, and what is wrong with them."""
        lost_rows = lost_trials = 0
        notes = []
        for trial in trials:
            folder = experiment / "trials" / trial.id
            expected, found = read_rows(self._folder / trial.id), read_rows(folder)
            assert len(expected) == EPOCHS + 1
            by_epoch = {row["epoch"]: _without_timing(row) for row in found}
            wrong = [row["epoch"] for row in expected if by_epoch.get(row["epoch"]) != _without_timing(row)]
            wrong += [row["epoch"] for row in found if row["epoch"] > EPOCHS]
            lost_rows += len(wrong)
            ending = read_ending(folder)
            whole = (
                ending is not None
                and ending.outcome == "finished"
                and _same(_last_state(self._folder / trial.id), _last_state(folder))
            )
            lost_trials += not whole
            if wrong or not whole:
                notes.append(f"{trial.id}: rows {wrong} missing or different, ended {ending}")
        return lost_rows, lost_trials, notes


def _without_timing(row: dict[str, float]) -> dict[str, Any]:
    return {key: repr(value) for key, value in row.items() if not key.startswith(TIMING)}


def _last_state(folder: Path) -> dict[str, Any] | None:
    path = folder / "checkpoints" / f"epoch_{EPOCHS:06d}.pt"
    return {k: v for k, v in read_checkpoint(path).items() if k not in TIMING} if path.is_file() else None


def _same(a: Any, b: Any) -> bool:
    """Whether nested containers hold the same structure and bit-equal tensors."""
    import torch

    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and torch.equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return isinstance(b, (list, tuple)) and len(a) == len(b) and all(map(_same, a, b))
    return bool(a == b)


_drivers: list[subprocess.Popen[bytes]] = []


class Sweep:
    """One experiment, launched as often as its faults ask for."""

    def __init__(self, name: str, scratch: Path, trials: list[Trial], storage: Path | None = None) -> None:
        self.name = name
        self.trials = trials
        self._scratch = scratch
        self._storage = storage or scratch / "runs"
        self.path = self._storage / name
        self._launches = 0
        self._rows_at_launch = 0
        self._driver: subprocess.Popen[bytes] | None = None
        self._started = time.monotonic()
        self._family: dict[int, str] = {}

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._started

    def plant(self, trial: Trial, faults: dict[int, str]) -> None:
        """Have a trial's process do something to itself at each of these epochs."""
        folder = self.path / "faults" / trial.id
        folder.mkdir(parents=True)
        for epoch, kind in faults.items():
            (folder / str(epoch)).write_text(kind)

    def struck(self, trial: Trial) -> int:
        """How many planted faults have happened."""
        return len(list((self.path / "faults" / trial.id).glob("*.done")))

    def launch(self, *more: str) -> None:
        """Start the driver: afresh the first time, with --resume from then on."""
        arguments = ["--space", str(self._scratch / "space.yaml"), "--name", self.name, "--storage", str(self._storage)]
        arguments += ["--cpu", "--max-concurrent", "2", *(["--resume"] if self._launches else []), *more]
        self._launches += 1
        self._rows_at_launch = self.rows()
        paths = [str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | {"RAY_TMPDIR": str(self._scratch), "PYTHONPATH": os.pathsep.join(paths)}
        with (self._scratch / f"{self.name}.log").open("ab") as log:
            self._driver = subprocess.Popen(
                [sys.executable, __file__, "drive", *arguments],
                stdout=log,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
        _drivers.append(self._driver)

    def wait(self) -> int:
        """Exit code of the driver; ended after a limit, which then counts as a loss."""
        assert self._driver is not None
        try:
            return self._driver.wait(LAUNCH_LIMIT_S)
        except subprocess.TimeoutExpired:
            print(f"  {self.name}: the driver did not end within {LAUNCH_LIMIT_S:.0f} s", flush=True)
            self._remember()
            self._driver.kill()
            return self._driver.wait()

    def rows(self) -> int:
        """Rows all trials have now."""
        return sum(len(read_rows(self.path / "trials" / trial.id)) for trial in self.trials)

    def wait_for_rows(self, count: int) -> bool:
        """Wait for so many rows, one of them new since the launch; False if the driver ended before."""
        assert self._driver is not None
        deadline = time.monotonic() + LAUNCH_LIMIT_S
        # Trials of a dead raylet train on for a moment, perhaps past the next share already.
        count = max(count, self._rows_at_launch + 1)
        while self.rows() < count:
            if self._driver.poll() is not None or time.monotonic() > deadline:
                return False
            time.sleep(0.02)
        return True

    def kill(self, number: signal.Signals, raylet: bool = False) -> int:
        """Send a signal to the driver, or to its raylet; the driver's exit code."""
        assert self._driver is not None
        self._remember()
        target = self._driver.pid
        if raylet:
            (target,) = [pid for pid in _descendants(self._driver.pid) if _name(pid) == "raylet"]
        os.kill(target, number)
        return self.wait()

    def running(self) -> list[Trial]:
        """Trials that have begun and not ended."""
        folders = {trial.id: self.path / "trials" / trial.id for trial in self.trials}
        return [t for t in self.trials if folders[t.id].is_dir() and read_ending(folders[t.id]) is None]

    def _remember(self) -> None:
        assert self._driver is not None
        self._family |= {pid: _birth(pid) for pid in _descendants(self._driver.pid)}

    def leftovers(self, patience_s: float = 30.0) -> int:
        """Processes of killed drivers that are still there after a while; they are ended."""
        deadline = time.monotonic() + patience_s
        while (alive := [p for p, birth in self._family.items() if _birth(p) == birth]) and (
            time.monotonic() < deadline
        ):
            time.sleep(0.2)
        for pid in alive:
            with contextlib.suppress(ProcessLookupError):  # gone since it was counted
                os.kill(pid, signal.SIGKILL)
        return len(alive)


def _stat(pid: int) -> list[str]:
    """Name, then the fields of /proc/PID/stat from the state on; empty if there is no such process, or a dead one."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return []
    name, _, rest = text[text.index("(") + 1 :].rpartition(")")
    fields = rest.split()
    return [] if fields[0] == "Z" else [name, *fields]


def _name(pid: int) -> str:
    return next(iter(_stat(pid)), "")


def _birth(pid: int) -> str:
    """When a process was started: its number alone may be used again."""
    stat = _stat(pid)
    return stat[20] if stat else ""


def _descendants(pid: int) -> list[int]:
    parent = {
        p: int(s[2]) for p in (int(e.name) for e in Path("/proc").iterdir() if e.name.isdigit()) if (s := _stat(p))
    }
    found, level = [], [pid]
    while level:
        level = [child for child, above in parent.items() if above in level]
        found += level
    return found


def inside_workers(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """Deaths and hangs of trial processes; Ray tries them again by itself."""
    sweep = Sweep("workers", scratch, reference.trials)
    kinds = {
        "worker SIGKILL before an epoch": ("kill", sorted(rng.sample(range(2, EPOCHS + 1), 4))),
        # The first one strikes before there is any checkpoint.
        "worker SIGKILL in the middle of a row": ("torn_row", [1, *sorted(rng.sample(range(2, EPOCHS), 3))]),
        "worker SIGKILL in the middle of a checkpoint": (
            "torn_checkpoint",
            [*sorted(rng.sample(range(2, EPOCHS, 2), 3)), EPOCHS],
        ),
        "hang": ("hang", sorted(rng.sample(range(2, EPOCHS + 1), 2))),
    }
    for trial, (kind, epochs) in zip(sweep.trials, kinds.values(), strict=True):
        sweep.plant(trial, dict.fromkeys(epochs, kind))
    sweep.launch()
    code = sweep.wait()
    tallies = []
    for trial, name in zip(sweep.trials, kinds, strict=True):
        tallies.append(_judge(reference, sweep, name, sweep.struck(trial), "nothing", [trial]))
        if code != 0:
            tallies[-1].notes.append(f"exit code {code}")
    return tallies


def nan(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """A policy turns to NaN: the trial ends there by name, and goes on from its checkpoint when asked to."""
    sweep = Sweep("nan", scratch, reference.trials)
    for trial in sweep.trials:
        sweep.plant(trial, {rng.randrange(2, EPOCHS + 1): "nan"})
    sweep.launch()
    sweep.wait()
    endings = [read_ending(sweep.path / "trials" / trial.id) for trial in sweep.trials]
    named = sum(ending is not None and ending.outcome == "nonfinite" for ending in endings)
    sweep.launch("--retry", "nonfinite")
    sweep.wait()
    injected = sum(map(sweep.struck, sweep.trials))
    tally = _judge(reference, sweep, "NaN in the policy", injected, "--resume --retry nonfinite")
    if named != injected:
        tally.notes.append(f"{injected - named} of them were not named nonfinite: {endings}")
    return [tally]


def killed(
    reference: Reference,
    scratch: Path,
    rng: random.Random,
    name: str,
    times: int,
    number: signal.Signals,
    raylet: bool = False,
) -> list[Tally]:
    """The driver or its raylet dies several times in one sweep."""
    sweep = Sweep(name.replace(" ", "_"), scratch, reference.trials)
    injected, codes = _strike(sweep, rng, times, lambda: sweep.kill(number, raylet))
    tally = _judge(reference, sweep, name, injected, "--resume")
    if number == signal.SIGTERM and set(codes) != {RESUMABLE}:
        tally.notes.append(f"exit codes {codes} instead of {RESUMABLE}")
    return [tally]


def damaged(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """The driver dies, and with it the newest checkpoint of every trial that ran."""

    def truncate(path: Path) -> None:
        os.truncate(path, path.stat().st_size // 3)

    def zero(path: Path) -> None:
        path.write_bytes(bytes(path.stat().st_size))

    def lose(path: Path) -> None:
        path.unlink()

    kinds = {"truncated": truncate, "zeroed": zero, "missing": lose}
    waiting = list(kinds)
    hit = dict.fromkeys(kinds, 0)
    sweep = Sweep("damaged_checkpoints", scratch, reference.trials)

    def strike() -> int:
        code = sweep.kill(signal.SIGKILL)
        sweep.leftovers()  # else a dying trial may still write a whole one
        # The kinds in turn; a strike before any checkpoint hits nothing, and its kind has its turn again.
        name = waiting.pop(0) if waiting else min(hit, key=hit.__getitem__)
        for trial in sweep.running():
            found = sorted((sweep.path / "trials" / trial.id / "checkpoints").glob("epoch_*.pt"))
            if found:
                kinds[name](found[-1])
                hit[name] += 1
        if not hit[name]:
            waiting.insert(0, name)
        return code

    _strike(sweep, rng, len(kinds) + 2, strike)
    return [
        _judge(reference, sweep, f"driver SIGKILL and newest checkpoint {name}", hit[name], "--resume")
        for name in kinds
    ]


def full_disk(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """The storage has no byte left (a small tmpfs, filled up) until the driver has ended."""
    disk = scratch / "disk"
    disk.mkdir()
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "tmpfs", str(disk)])
    if mount.returncode:
        return [Tally("full disk", 0, "not run: mounting a tmpfs needs root")]
    try:
        sweep = Sweep("full_disk", scratch, reference.trials, storage=disk)
        ballast = disk / "ballast"

        def strike() -> int:
            with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:
                while True:  # until it raises: no space left
                    file.write(bytes(4096))
            code = sweep.wait()
            ballast.unlink()
            return code

        injected, codes = _strike(sweep, rng, 2, strike)
        tally = _judge(reference, sweep, "full disk", injected, "--resume")
        if set(codes) != {RESUMABLE}:
            tally.notes.append(f"exit codes {codes} instead of {RESUMABLE}")
        return [tally]
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def _strike(sweep: Sweep, rng: random.Random, times: int, strike: Callable[[], int]) -> tuple[int, list[int]]:
    """Launch, strike once some rows have been written, and again; at last let it end.

    Returns:
        How often it was struck before it had ended, and the exit codes of the drivers struck.
    """
    total = len(sweep.trials) * (EPOCHS + 1)
    codes: list[int] = []
    for index in range(times):
        sweep.launch()
        # Spread over the sweep, each share of it drawn on; rows not yet checkpointed are written again.
        share = total * (index + rng.uniform(0.3, 0.9)) / (times + 0.5)
        if not sweep.wait_for_rows(round(share)):
            break
        codes.append(strike())
        print(f"  {sweep.name}: struck at about {share:.0f} of {total} rows, exit code {codes[-1]}", flush=True)
    sweep.launch()
    code = sweep.wait()
    if code:
        print(f"  {sweep.name}: the last resume ended with {code}", flush=True)
    return len(codes), codes


def _judge(
    reference: Reference, sweep: Sweep, fault: str, injected: int, ended_by: str, trials: list[Trial] | None = None
) -> Tally:
    rows, lost, notes = reference.compare(sweep.path, trials or sweep.trials)
    left = sweep.leftovers()
    if left:
        notes.append(f"{left} processes of killed drivers were still there 30 s later")
    return Tally(fault, injected, ended_by, rows, lost, sweep.seconds, notes)


@contextlib.contextmanager
def _scratch(keep: bool) -> Iterator[Path]:
    # Ray's sockets lie below, and their paths may have 107 characters.
    path = Path(tempfile.mkdtemp(prefix="faults_", dir="/tmp"))
    try:
        yield path
    finally:
        for driver in _drivers:  # one is still there if the campaign itself was interrupted
            if driver.poll() is None:
                driver.kill()
                driver.wait()
        if keep:
            print(f"kept: {path}")
        else:
            shutil.rmtree(path)


CAMPAIGNS: dict[str, Callable[[Reference, Path, random.Random], list[Tally]]] = {
    "disk": full_disk,
    "raylet": lambda *a: killed(*a, "raylet SIGKILL", 3, signal.SIGKILL, True),
    "nan": nan,
    "workers": inside_workers,
    "checkpoints": damaged,
    "sigterm": lambda *a: killed(*a, "driver SIGTERM", 3, signal.SIGTERM),
    "driver": lambda *a: killed(*a, "driver SIGKILL", 3, signal.SIGKILL),
}


def main() -> int:
    """Run the campaign; 1 if anything was lost."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--seed", type=int, default=0, help="of when and where faults strike")
    p.add_argument("--only", nargs="+", choices=list(CAMPAIGNS), help="some of the campaign")
    p.add_argument("--keep", action="store_true", help="keep the experiments and logs")
    p.add_argument("--results", type=Path, default=RESULTS, help="folder the table is appended in")
    args = p.parse_args()
    started = time.monotonic()
    tallies: list[Tally] = []
    with _scratch(args.keep) as scratch:
        (scratch / "space.yaml").write_text(dump_yaml(SPACE))
        trials = resolve_trials(load_space(scratch / "space.yaml"))
        reference = Reference(trials, scratch / "reference")
        print(f"reference: {len(trials)} trials in {time.monotonic() - started:.0f} s", flush=True)
        for name in args.only or CAMPAIGNS:
            # A seed of its own, so that a part alone repeats what it does in the whole.
            found = CAMPAIGNS[name](reference, scratch, random.Random(f"{args.seed} {name}"))
            for tally in found:
                print(
                    f"{tally.fault}: survived {tally.survived} of {tally.injected}, {tally.seconds:.0f} s", flush=True
                )
                for note in tally.notes:
                    print(f"  {note}", flush=True)
            tallies += found
    header = ["fault", "injected", "survived", "lost rows", "lost trials", "sweep s", "ended by"]
    cells = [
        [
            t.fault,
            f"{t.injected}",
            f"{t.survived}",
            f"{t.lost_rows}",
            f"{t.lost_trials}",
            f"{t.seconds:.0f}",
            t.ended_by,
        ]
        for t in tallies
    ]
    sums = [sum(getattr(t, name) for t in tallies) for name in ("injected", "survived", "lost_rows", "lost_trials")]
    cells.append(["all", *map(str, sums), f"{time.monotonic() - started:.0f}", ""])
    title = f"Faults survived, {len(trials)} CartPole trials of {EPOCHS} epochs a sweep, seed {args.seed}"
    notes = [f"- {tally.fault}: {note}" for tally in tallies for note in tally.notes]
    publish(
        "faults",
        title,
        "cpu",
        "\n".join([markdown_table(header, cells), *([""] if notes else []), *notes]),
        args.results,
    )
    return 1 if notes or sums[0] != sums[1] else 0


if __name__ == "__main__":
    sys.exit(drive(sys.argv[2:]) if sys.argv[1:2] == ["drive"] else main())
