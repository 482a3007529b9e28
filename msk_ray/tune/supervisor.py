"""The driver's decisions while trials run: when to stop everything, and endings that trials cannot write themselves."""

import pickle
import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from ray.exceptions import RayActorError
from ray.tune import Callback

from msk_ray.errors import StorageFailure, storage_failure
from msk_ray.experiment.attempts import FIRST, read_attempt
from msk_ray.experiment.layout import ERROR_FILE, HANG_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.outcomes import Ending, Outcome, read_ending, write_ending
from msk_ray.experiment.trial import Trial
from msk_ray.files import last_lines
from msk_ray.signals import StopRequest
from msk_ray.text import printable
from msk_ray.tune.console import Console
from msk_ray.tune.schedulers import BEST, METRIC

SHUTDOWN_GRACE_S = 120.0
"""How long trials may take to end their epoch and save after a request to stop [s]."""
CHECK_S = 2.0
"""Interval at which the experiment is looked for [s]: without its manifest, trials cannot save themselves."""
LONGEST_STEP_S = 5.0
"""Longest time that a step of Tune's loop counts for [s]: if it took longer, this process was suspended."""


class Supervisor(Callback):
    """Follows the trials: records endings that only the driver sees, stops everything on request or when the experiment
    disappears or has another owner, and informs the console."""

    def __init__(
        self,
        experiment: Experiment,
        trial_of: Callable[[dict[str, Any]], Trial],
        console: Console,
        stop: StopRequest,
        guard: Callable[[], None],
        waiting: Iterable[Trial] = (),
        started: Iterable[Trial] = (),
    ) -> None:
        """
        Args:
            experiment: the trials' experiment.
            trial_of: the trial of a Tune config.
            console: prints events.
            stop: request to stop, checked after each event.
            guard: called before each write; raises if another driver owns the experiment by now.
            waiting: known trials that are still to run.
            started: trials started before, in order.
        """
        self._experiment = experiment
        self._trial_of = trial_of
        self.console = console
        self._stop = stop
        self._guard = guard
        self._waiting = {trial.id for trial in waiting}
        self._attempts: dict[str, int] = {}
        """Running trials, and the attempt of each."""
        self._saving: set[str] = set()
        self.started: list[Trial] = list(started)
        """Started trials, in order, with their positions."""
        self._stopping = False
        self._stopping_s = 0.0
        self._last_step = self._checked = time.monotonic()
        self.storage_failure: StorageFailure | None = None
        """Error of a trial that could not write. Then everything is stopped, because every trial would meet it."""

    def __getstate__(self) -> dict[str, Any]:
        # Ray pickles callbacks into its own state, which is never read: resuming starts from the trials' folders.
        return {}

    def waiting(self) -> int:
        """Number of known trials that are still to start, or to start again."""
        return len(self._waiting)

    @property
    def stopped(self) -> bool:
        """Whether, after a request to stop, every running trial has saved itself, or time is up."""
        return self._stopping and (not self._saving or self._stopping_s > SHUTDOWN_GRACE_S)

    def on_step_begin(self, iteration: int, trials: list[Any], **info: Any) -> None:
        self._guard()

    def on_step_end(self, iteration: int, trials: list[Any], **info: Any) -> None:
        now = time.monotonic()
        if self._stopping:
            self._stopping_s += min(now - self._last_step, LONGEST_STEP_S)
        self._last_step = now
        if self._stop and not self._stopping:
            assert self._stop.signal is not None
            self._stop_trials()
            self.console.say(
                f"{self._stop.signal.name}: {len(self._saving)} trials save themselves at the end of their epoch ..."
            )
        self.console.tick()
        if now - self._checked >= CHECK_S:
            self._checked = now
            self._experiment.check_there()

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        mine = self._trial_of(trial.config)
        attempt = read_attempt(self._experiment.trial_folder(mine.id))
        self._waiting.discard(mine.id)
        if all(mine.id != known.id for known in self.started):
            self.started.append(replace(mine, index=len(self.started)))
        self._attempts[mine.id] = attempt.number
        self.console.started(mine, attempt, quiet=self._stopping)

    def on_trial_result(
        self, iteration: int, trials: list[Any], trial: Any, result: dict[str, Any], **info: Any
    ) -> None:
        if METRIC in result:
            self.console.evaluated(self._trial_of(trial.config), result["epoch"], result[METRIC], result[BEST])

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        if not self._meet_storage_failure(trial):
            mine = self._trial_of(trial.config)
            # It has no process until Tune starts a new one, which may wait for the other trials.
            before = self._attempts.pop(mine.id, FIRST.number)
            self._saving.discard(mine.id)
            self._waiting.add(mine.id)
            attempt = read_attempt(self._experiment.trial_folder(mine.id))
            if attempt.number > before:
                self.console.attempted_again(mine, attempt)
            else:
                self.console.retried(mine, self._reason(mine, trial))

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        mine = self._trial_of(trial.config)
        folder = self._experiment.trial_folder(mine.id)
        self._saving.discard(mine.id)
        self._attempts.pop(mine.id, None)
        ending = read_ending(folder)
        if ending is not None and ending.outcome is Outcome.ERROR and (folder / ERROR_FILE).is_file():
            self.console.failed(mine, ending.why, folder)
        elif ending is not None:
            self.console.ended(mine, ending)
        else:
            self.console.left(mine)  # paused by a request to stop, or never started

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        if self._meet_storage_failure(trial):
            return
        self._guard()
        mine = self._trial_of(trial.config)
        folder = self._experiment.trial_folder(mine.id)
        self._saving.discard(mine.id)
        self._attempts.pop(mine.id, None)
        ending = Ending(Outcome.ERROR, self._reason(mine, trial))
        write_ending(folder, ending)
        self.console.failed(mine, ending.why, folder)

    def pruned(self, trial_id: str, ending: Ending) -> None:
        """A scheduler stops a trial; its process cannot write its ending."""
        self._guard()
        write_ending(self._experiment.trial_folder(trial_id), ending)

    def _meet_storage_failure(self, trial: Any) -> bool:
        """Whether the disk failed for a trial. Then all trials are stopped, without an ending."""
        error = _error_of(trial)
        failure = None if error is None else storage_failure(error)
        if failure is None:
            return False
        mine = self._trial_of(trial.config)
        self._attempts.pop(mine.id, None)
        self.console.left(mine)
        if self.storage_failure is None:
            self.storage_failure = failure
            self.console.say(f"{mine.id} {printable(str(failure))}; stopping all trials ...")
        if not self._stopping:
            self._stop_trials()
        self._saving.discard(mine.id)
        return True

    def _stop_trials(self) -> None:
        self._guard()
        self._stopping = True
        self._saving = set(self._attempts)
        try:
            self._experiment.check_there()  # Ray may have created an empty folder in its place
            self._experiment.stop_file.touch()
        except StorageFailure as failure:
            self.console.say(f"trials are not asked to stop: {failure}")
        except OSError as error:
            # The trials will fail on the same disk at their next row, and stop.
            self.console.say(f"cannot write {self._experiment.stop_file}: {error.strerror}")

    def _reason(self, mine: Trial, trial: Any) -> str:
        """Why a trial's process ended early, on one line."""
        return printable(_reason(self._experiment.trial_folder(mine.id), trial))


def remove_remains(experiment: Experiment) -> None:
    """Remove the folders that Ray has written where an experiment has disappeared. Ray creates the folders it writes
    to, and an experiment that is moved back would end up inside them."""
    path = experiment.path
    if not path.is_dir() or experiment.lost() is None:
        return
    # A request to stop, written at the first sign of the loss, may be there too.
    if {child.name for child in path.iterdir()} <= {experiment.tune.name, experiment.stop_file.name}:
        shutil.rmtree(path)


def _error_of(trial: Any) -> Exception | None:
    """The exception that ended a Ray trial's process; None if there was none.

    Ray's own accessor reads a file, which arrives later, or never if the disk is full.
    """
    path = trial.pickled_error_file
    if path is None or not Path(path).is_file():
        return None
    error: Exception = pickle.loads(Path(path).read_bytes())
    return error


def _reason(folder: Path, trial: Any) -> str:
    hang_file, error_file = folder / HANG_FILE, folder / ERROR_FILE
    if hang_file.is_file() and hang_file.stat().st_size:
        return f"it hung; its stacks are in {hang_file}"
    if error_file.is_file():
        return next(iter(last_lines(error_file, 1)), "its error was not recorded")
    error = _error_of(trial)
    if error is None or isinstance(error, RayActorError):
        times = "" if trial.num_failures < 2 else f", {trial.num_failures} times now"
        return f"its process died (killed, or out of memory){times}"
    return str(error).strip().splitlines()[-1]
