"""What the terminal shows while an experiment runs: a line an event, and now and then where everything stands."""

import math
import pickle
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ray.exceptions import RayActorError
from ray.tune import Callback

from msk_ray.errors import StorageFailure, storage_failure
from msk_ray.experiment.damage import DamagedFile
from msk_ray.experiment.eta import eta
from msk_ray.experiment.halved import Halved, read_halved
from msk_ray.experiment.layout import ERROR_FILE, HANG_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.outcomes import Ending, Outcome, read_ending, write_ending
from msk_ray.experiment.trial import Trial
from msk_ray.progress import format_duration
from msk_ray.signals import StopRequest
from msk_ray.text import printable, printable_lines
from msk_ray.tune.adapters import BEST, METRIC, STARTS_ANEW

STATUS_INTERVAL_S = 30.0
SHUTDOWN_GRACE_S = 120.0
"""How long trials may take to reach the end of their epoch and save, after a request to stop."""
LONGEST_STEP_S = 5.0
"""What a step of Tune's loop counts for at most: in the rest this process was itself stopped or asleep [s]."""


@dataclass
class _Running:
    trial: Trial
    since: float
    first_epoch: int | None = None
    epoch: int = 0
    score: float = float("nan")
    best: float = float("-inf")


class Supervisor(Callback):
    """Follows the trials: prints, names the endings that only the driver sees, and stops everything on request."""

    def __init__(
        self,
        experiment: Experiment,
        trials: list[Trial],
        trial_of: Callable[[dict[str, Any]], Trial],
        concurrent: int,
        stop: StopRequest,
        guard: Callable[[], None],
        started: Iterable[Trial] = (),
    ) -> None:
        """
        Args:
            experiment: whose trials they are.
            trials: those to be run, as far as they are known.
            trial_of: the trial that a Tune config stands for.
            concurrent: trials at once.
            stop: asked between any two events.
            guard: called before anything is written; raises if the experiment is another driver's by now.
            started: trials started before, in that order.
        """
        self._guard = guard
        self._experiment = experiment
        self._waiting = {trial.id: trial for trial in trials}
        self._trial_of = trial_of
        self._concurrent = concurrent
        self._stop = stop
        self._running: dict[str, _Running] = {}
        self._saving: set[str] = set()
        self._ended = 0
        self.started: list[Trial] = list(started)
        """Trials that were started, in that order, each once, numbered anew."""
        self._bests: dict[str, tuple[float, Trial]] = {}
        """The best score of each trial that has reported one, and the trial."""
        self._halved: dict[str, Halved] = {}
        """Those of the trials seen here that run with half their worlds."""
        self._starting_anew: dict[str, bool] = {}
        """Trials halved in this driver's life, and whether the failure that leads to it is still to come."""
        self._start = time.monotonic()
        # Kept, because what Ray itself prints is sent elsewhere while trials run.
        self._out = sys.stdout
        self._last_status = self._start
        self._seconds_per_epoch: dict[str, float] = {}
        self._stopping = False
        self._stopping_s = 0.0
        self._last_step = self._start
        self.storage_failure: StorageFailure | None = None
        """What a trial met when it wrote; then everything is stopped, as every trial would meet it."""

    def __getstate__(self) -> dict[str, Any]:
        # Ray pickles callbacks into its own state, which is never read back: resuming begins from the trials' folders.
        return {key: value for key, value in self.__dict__.items() if key not in ("_out", "_guard")}

    def waiting(self) -> int:
        """How many trials have not started yet, as far as they are known."""
        return len(self._waiting)

    @property
    def stopped(self) -> bool:
        """Whether a request to stop has been carried out: every trial that ran has saved itself, or time is up."""
        return self._stopping and (not self._saving or self._stopping_s > SHUTDOWN_GRACE_S)

    def on_step_end(self, iteration: int, trials: list[Any], **info: Any) -> None:
        now = time.monotonic()
        if self._stopping:
            self._stopping_s += min(now - self._last_step, LONGEST_STEP_S)
        self._last_step = now
        if self._stop and not self._stopping:
            self._begin_stop()
        if time.monotonic() - self._last_status >= STATUS_INTERVAL_S:
            self._last_status = time.monotonic()
            self._say(self.status())

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        mine = self._trial_of(trial.config)
        self._waiting.pop(mine.id, None)
        self._look_up_halved(mine)
        again = mine.id in self._running
        if all(mine.id != trial.id for trial in self.started):
            self.started.append(replace(mine, index=len(self.started)))
        self._running[mine.id] = _Running(mine, time.monotonic())
        if not self._stopping:
            self._say(f"{mine.id} {'again' if again else 'start'}  {self._name(mine)}")

    def on_trial_result(
        self, iteration: int, trials: list[Any], trial: Any, result: dict[str, Any], **info: Any
    ) -> None:
        mine = self._trial_of(trial.config)
        if STARTS_ANEW in result:
            # The failure by which it gets a fresh process is not one of those that `max_failures` counts.
            trial.max_failures += 1
            self._starting_anew[mine.id] = True
        if METRIC not in result:
            return
        run = self._running.setdefault(mine.id, _Running(mine, time.monotonic()))
        run.epoch, run.score = result["epoch"], result[METRIC]
        if run.first_epoch is None:
            # Speed is taken from the first report on: what came before includes start-up and compilation.
            run.first_epoch, run.since = run.epoch, time.monotonic()
        elif run.epoch > run.first_epoch:
            self._seconds_per_epoch[mine.id] = (time.monotonic() - run.since) / (run.epoch - run.first_epoch)
        run.best = max(run.best, result[BEST])
        if not math.isfinite(run.best):
            return  # no score has been a number yet
        best = self._best
        if mine.id not in self._bests or run.best > self._bests[mine.id][0]:
            self._bests[mine.id] = run.best, mine
        if best is None or run.best > best[0]:
            when = f" at epoch {run.epoch}/{mine.epochs}" if run.score == run.best else ""
            self._say(f"{mine.id} best so far: score {run.best:.5g}{when}{self._in_brackets(mine)}")

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        if self._meet_storage_failure(trial):
            return
        mine = self._trial_of(trial.config)
        if self._starting_anew.get(mine.id):
            self._starting_anew[mine.id] = False
            self._look_up_halved(mine)
            halved = self._halved[mine.id]
            # What it scored with all its worlds is set aside.
            self._bests.pop(mine.id, None)
            self._seconds_per_epoch.pop(mine.id, None)
            self._say(f"{mine.id} ran out of memory with {halved.asked} worlds; starting anew with {halved.worlds}")
            return
        why = self._reason(mine, trial)
        self._say(f"{mine.id} {why}; trying again from its newest checkpoint")

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        mine = self._trial_of(trial.config)
        self._saving.discard(mine.id)
        run = self._running.pop(mine.id, None)
        ending = read_ending(self._experiment.trial_folder(mine.id))
        if ending is None:
            return  # paused by a request to stop, or never begun
        self._ended += 1
        compared = ending.outcome in (Outcome.STOPPED_ASHA, Outcome.STOPPED_MEDIAN)  # their reason names the score
        score = "" if run is None or compared or run.best == float("-inf") else f"; best score {run.best:.5g}"
        self._say(f"{mine.id} {ending.outcome}: {printable(ending.why)}{score}{self._in_brackets(mine)}")

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        if self._meet_storage_failure(trial):
            return
        self._guard()
        mine = self._trial_of(trial.config)
        folder = self._experiment.trial_folder(mine.id)
        self._saving.discard(mine.id)
        self._running.pop(mine.id, None)
        self._ended += 1
        ending = Ending(Outcome.ERROR, self._reason(mine, trial))
        write_ending(folder, ending)
        self._say(f"{mine.id} error: {ending.why}; see {folder}{self._in_brackets(mine)}")

    def pruned(self, trial_id: str, ending: Ending) -> None:
        """A scheduler stops a trial: its process will not live to write its ending."""
        self._guard()
        write_ending(self._experiment.trial_folder(trial_id), ending)

    def status(self) -> str:
        """One line on where everything stands."""
        parts = [f"{len(self._running)} running", f"{len(self._waiting)} waiting", f"{self._ended} ended"]
        best = self._best
        if best is not None:
            parts.append(f"best {best[0]:.5g} ({best[1].id})")
        running = [
            (run.trial.epochs - run.epoch, self._seconds_per_epoch.get(run.trial.id)) for run in self._running.values()
        ]
        left = eta(running, [trial.epochs for trial in self._waiting.values()], self._concurrent)
        if left is not None:
            parts.append(f"at most {format_duration(left)} left")
        lines = [" · ".join(parts)]
        for run in self._running.values():
            score = "no evaluation yet" if math.isnan(run.score) else f"score {run.score:.5g} (best {run.best:.5g})"
            lines.append(
                f"    {run.trial.id}  epoch {run.epoch:>4}/{run.trial.epochs}  {score}  {self._name(run.trial)}"
            )
        return "\n".join(lines)

    @property
    def _best(self) -> tuple[float, Trial] | None:
        return max(self._bests.values(), key=lambda best: best[0], default=None)

    def _look_up_halved(self, trial: Trial) -> None:
        try:
            halved = read_halved(self._experiment.trial_folder(trial.id))
        except DamagedFile:
            halved = None  # the trial ends by that, and says so
        if halved is not None:
            self._halved[trial.id] = halved

    def _meet_storage_failure(self, trial: Any) -> bool:
        """Whether the disk failed a trial; then all are stopped, and none has ended by that."""
        error = _error_of(trial)
        failure = None if error is None else storage_failure(error)
        if failure is None:
            return False
        trial_id = self._trial_of(trial.config).id
        self._running.pop(trial_id, None)
        if self.storage_failure is None:
            self.storage_failure = failure
            self._say(f"{trial_id} {printable(str(failure))}; stopping all trials ...")
        if not self._stopping:
            self._stop_trials()
        self._saving.discard(trial_id)
        return True

    def _stop_trials(self) -> None:
        self._guard()
        self._stopping = True
        self._saving = set(self._running)
        try:
            self._experiment.stop_file.touch()
        except OSError as error:
            # Then the trials meet the same disk at their next row, and end by that.
            self._say(f"cannot write {self._experiment.stop_file}: {error.strerror}")

    def _begin_stop(self) -> None:
        assert self._stop.signal is not None
        self._stop_trials()
        self._say(f"{self._stop.signal.name}: {len(self._saving)} trials save themselves at the end of their epoch ...")

    def _say(self, text: str) -> None:
        shown = printable_lines(text)
        print(f"[{format_duration(time.monotonic() - self._start):>6}] {shown}", file=self._out, flush=True)

    def _name(self, trial: Trial) -> str:
        return f"{printable(trial.variant)} seed={trial.seed}{self._in_brackets(trial)}"

    def _in_brackets(self, trial: Trial) -> str:
        """That a trial runs with half its worlds, if it does."""
        halved = self._halved.get(trial.id)
        return "" if halved is None else f" ({halved})"

    def _reason(self, mine: Trial, trial: Any) -> str:
        """Why a trial's process ended before its time, on one line."""
        counted = trial.num_failures - (mine.id in self._starting_anew)
        return printable(_reason(self._experiment.trial_folder(mine.id), trial, counted))


def _error_of(trial: Any) -> Exception | None:
    """The exception that ended a Ray trial's process; None if there was none.

    Ray's own accessor reads the storage, where the file arrives later, or never on a full disk.
    """
    path = trial.pickled_error_file
    if path is None or not Path(path).is_file():
        return None
    error: Exception = pickle.loads(Path(path).read_bytes())
    return error


def _reason(folder: Path, trial: Any, failures: int) -> str:
    hang_file, error_file = folder / HANG_FILE, folder / ERROR_FILE
    if hang_file.is_file() and hang_file.stat().st_size:
        return f"it hung; where is in {hang_file}"
    if error_file.is_file():
        return error_file.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1]
    error = _error_of(trial)
    if error is None or isinstance(error, RayActorError):
        times = "" if failures < 2 else f", {failures} times now"
        return f"its process died (killed, or out of memory){times}"
    return str(error).strip().splitlines()[-1]
