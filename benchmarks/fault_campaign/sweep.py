"""One experiment under fire, as processes and files show it from outside."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import msk_ray
from fault_campaign.processes import birth_of, catches, command_of, descendants_of, name_of
from msk_ray.experiment.layout import MANIFEST_FILE
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.outcomes import read_ending
from msk_ray.experiment.trial import Trial

REPOSITORY = Path(msk_ray.__file__).resolve().parent.parent
COMMAND = Path(__file__).resolve().parent.parent / "faults.py"
"""Whose first argument `drive` makes it a driver."""
LAUNCH_LIMIT_S = 900.0
PATIENCE_S = 10.0
"""How long processes of a killed driver may take to end [s]."""

_drivers: list[subprocess.Popen[bytes]] = []


class Sweep:
    """One experiment, launched as often as its faults ask for."""

    def __init__(self, name: str, scratch: Path, trials: list[Trial], storage: Path | None = None) -> None:
        self.name = name
        self.trials = trials
        self._scratch = scratch
        self._storage = storage or scratch / "runs"
        self.path = self._storage / name
        self._rows_at_launch = self._printed_at_launch = 0
        self._driver: subprocess.Popen[bytes] | None = None
        self._started = time.monotonic()
        self._family: dict[int, str] = {}
        self.codes: list[int] = []
        """Exit codes of its drivers."""

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
        """Start the driver: with --resume, once there is an experiment."""
        self._printed_at_launch = len(self.printed())
        self._driver = self._start([*(["--resume"] if (self.path / MANIFEST_FILE).is_file() else []), *more])
        self._rows_at_launch = self.rows()

    def beside(self) -> int:
        """Try to resume the experiment while its driver is running; the exit code of the second one."""
        second = self._start(["--resume"])
        self.codes.append(second.wait())
        return self.codes[-1]

    def hand_over(self) -> int:
        """Have a second driver take the experiment over; the exit code of the first one."""
        assert self._driver is not None
        self._remember()
        first, self._driver = self._driver, self._start(["--resume", "--force"])
        self.codes.append(first.wait())
        return self.codes[-1]

    def _start(self, more: list[str]) -> subprocess.Popen[bytes]:
        arguments = ["--space", str(self._scratch / "space.yaml"), "--name", self.name, "--storage", str(self._storage)]
        arguments += ["--cpu", "--max-concurrent", "2", *more]
        paths = [str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | {"RAY_TMPDIR": str(self._scratch), "PYTHONPATH": os.pathsep.join(paths)}
        with self._log.open("ab") as log:
            driver = subprocess.Popen(
                [sys.executable, str(COMMAND), "drive", *arguments],
                stdout=log,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
        _drivers.append(driver)
        return driver

    def wait(self) -> int:
        """Exit code of the driver; ended after a limit, which then counts as a loss."""
        assert self._driver is not None
        try:
            code = self._driver.wait(LAUNCH_LIMIT_S)
        except subprocess.TimeoutExpired:
            print(f"  {self.name}: the driver did not end within {LAUNCH_LIMIT_S:.0f} s", flush=True)
            self._remember()
            self._driver.kill()
            code = self._driver.wait()
        self.codes.append(code)
        return code

    @property
    def _log(self) -> Path:
        return self._scratch / f"{self.name}.log"

    def printed(self) -> str:
        """What its drivers have printed."""
        return self._log.read_text(errors="replace") if self._log.is_file() else ""

    def tracebacks(self) -> int:
        """How many tracebacks its drivers have printed."""
        return self.printed().count("Traceback (most recent call last)")

    def wait_for_line(self, text: str) -> bool:
        """Wait until the driver has printed a text since its launch; False if it ended before."""
        assert self._driver is not None
        while text not in self.printed()[self._printed_at_launch :]:
            if self._driver.poll() is not None:
                return False
            time.sleep(0.02)
        return True

    def wait_until_it_listens(self) -> None:
        """Wait until the driver has handlers for signals, which is the first that it does."""
        assert self._driver is not None
        while self._driver.poll() is None and not catches(self._driver.pid, signal.SIGTERM):
            time.sleep(0.005)

    def rows(self) -> int:
        """Rows all trials have now."""
        return sum(len(read_rows(self.path / "trials" / trial.id)) for trial in self.trials)

    def wait_for_rows(self, count: int) -> bool:
        """Wait for a number of rows, one of them new since the launch; False if the driver ended before."""
        assert self._driver is not None
        deadline = time.monotonic() + LAUNCH_LIMIT_S
        # Trials of a dead raylet train on for a moment, perhaps past the next share already.
        count = max(count, self._rows_at_launch + 1)
        while self.rows() < count:
            if self._driver.poll() is not None or time.monotonic() > deadline:
                return False
            time.sleep(0.02)
        return True

    def send(self, number: signal.Signals, daemon: str | None = None) -> None:
        """Send a signal to the driver, or to a daemon of its Ray."""
        assert self._driver is not None
        target = self._driver.pid
        if daemon is not None:
            (target,) = [pid for pid in descendants_of(self._driver.pid) if name_of(pid) == daemon]
        os.kill(target, number)

    def ending(self, trial: Trial) -> str | None:
        """How a trial ended."""
        ending = read_ending(self.path / "trials" / trial.id)
        return None if ending is None else str(ending.outcome)

    def kill(self, number: signal.Signals, daemon: str | None = None, group: bool = False) -> int:
        """Send a signal to the driver, to a daemon of its Ray, or to every process of the sweep; the driver's exit
        code."""
        assert self._driver is not None
        self._remember()
        if daemon is not None:
            self.send(number, daemon)
        else:
            (os.killpg if group else os.kill)(self._driver.pid, number)
        return self.wait()

    def running(self) -> list[Trial]:
        """Trials that have begun and not ended."""
        folders = {trial.id: self.path / "trials" / trial.id for trial in self.trials}
        return [t for t in self.trials if folders[t.id].is_dir() and read_ending(folders[t.id]) is None]

    def _remember(self) -> None:
        assert self._driver is not None
        self._family |= {pid: birth_of(pid) for pid in descendants_of(self._driver.pid)}

    def leftovers(self, patience_s: float = PATIENCE_S) -> list[str]:
        """Names of processes of killed drivers that are still there after a while; they are ended."""
        deadline = time.monotonic() + patience_s
        while (alive := [p for p, birth in self._family.items() if birth_of(p) == birth]) and (
            time.monotonic() < deadline
        ):
            time.sleep(0.2)
        names = [command_of(pid) for pid in alive]
        for pid in alive:
            with contextlib.suppress(ProcessLookupError):  # gone since it was counted
                os.kill(pid, signal.SIGKILL)
        return names


@contextlib.contextmanager
def scratch_folder(keep: bool) -> Iterator[Path]:
    # Ray's sockets lie below, and their paths may have 107 characters.
    path = Path(tempfile.mkdtemp(prefix="fc_", dir="/tmp"))
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
