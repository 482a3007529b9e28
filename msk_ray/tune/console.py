"""Terminal output while an experiment runs: a line per event, and a periodic overview."""

import math
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass

from msk_ray.experiment.attempts import FIRST, Attempt
from msk_ray.experiment.outcomes import Ending, Outcome
from msk_ray.experiment.records import eta
from msk_ray.experiment.trial import Trial
from msk_ray.progress import format_duration
from msk_ray.text import printable, printable_lines

STATUS_INTERVAL_S = 30.0
BEFORE_FIRST = "compiles kernels that are not in Warp's cache, records, then trains"
"""What a trial is doing before its first evaluation."""


@dataclass
class _Running:
    trial: Trial
    since: float
    first_epoch: int | None = None
    epoch: int = 0
    score: float = math.nan
    best: float = -math.inf


class Console:
    """Prints events of trials. Decides nothing, and reads neither Ray nor the disk."""

    def __init__(self, waiting: Iterable[Trial], concurrent: int) -> None:
        """
        Args:
            waiting: known trials that are still to run.
            concurrent: number of trials that run at the same time.
        """
        self._waiting = {trial.id: trial for trial in waiting}
        self._environments = dict.fromkeys(trial.environment for trial in self._waiting.values())
        self._concurrent = concurrent
        self._running: dict[str, _Running] = {}
        self._begun: set[str] = set()
        self._ended = 0
        self._bests: dict[str, tuple[float, Trial]] = {}
        """(best score, trial) of each trial that has reported a score."""
        self._leaders: dict[str, tuple[float, Trial]] = {}
        """The best of them in each environment."""
        self._attempts: dict[str, Attempt] = {}
        self._seconds_per_epoch: dict[str, float] = {}
        self._start = time.monotonic()
        self._last_status = self._start
        # The terminal, stored because sys.stdout is redirected while trials run.
        self._out = sys.stdout

    def say(self, text: str) -> None:
        """Print lines with the time since the start."""
        shown = printable_lines(text)
        print(f"[{format_duration(time.monotonic() - self._start):>6}] {shown}", file=self._out, flush=True)

    def started(self, trial: Trial, attempt: Attempt, quiet: bool = False) -> None:
        """A trial has started or restarted; `quiet` prints nothing."""
        self._waiting.pop(trial.id, None)
        self._attempts[trial.id] = attempt
        again = trial.id in self._begun
        self._begun.add(trial.id)
        self._running[trial.id] = _Running(trial, time.monotonic())
        if not quiet:
            self.say(f"{trial.id} {'again' if again else 'start'}  {self._name(trial)}")

    def evaluated(self, trial: Trial, epoch: int, score: float, best: float) -> None:
        """A trial has been evaluated; `best` is its best score so far."""
        run = self._running.setdefault(trial.id, _Running(trial, time.monotonic()))
        self._environments.setdefault(trial.environment)
        run.epoch, run.score = epoch, score
        if run.first_epoch is None:
            # Measure speed from the first result on; before that is start-up and compilation.
            run.first_epoch, run.since = epoch, time.monotonic()
        elif epoch > run.first_epoch:
            self._seconds_per_epoch[trial.id] = (time.monotonic() - run.since) / (epoch - run.first_epoch)
        run.best = max(run.best, best)
        if not math.isfinite(run.best):
            return  # no finite score yet
        if trial.id not in self._bests or run.best > self._bests[trial.id][0]:
            self._bests[trial.id] = run.best, trial
        if self._leads(run.best, trial):
            when = f" at epoch {epoch}/{trial.epochs}" if score == run.best else ""
            where = f" in {trial.environment}" if len(self._environments) > 1 else ""
            self.say(f"{trial.id} best so far{where}: score {run.best:.5g}{when}{self._suffix(trial)}")

    def retried(self, trial: Trial, why: str) -> None:
        """A trial's process has died and will be replaced."""
        self._running.pop(trial.id, None)
        self._waiting[trial.id] = trial
        self.say(f"{trial.id} {why}; retrying from its newest checkpoint")

    def attempted_again(self, trial: Trial, attempt: Attempt) -> None:
        """A trial will have another attempt."""
        self._running.pop(trial.id, None)
        # Scores with all its worlds no longer count.
        self._bests.pop(trial.id, None)
        self._leaders = {}
        for score, other in self._bests.values():
            self._leads(score, other)
        self._seconds_per_epoch.pop(trial.id, None)
        self._waiting[trial.id] = trial
        self.say(f"{trial.id} ran out of memory; it restarts with {attempt}")

    def ended(self, trial: Trial, ending: Ending) -> None:
        """A trial has ended."""
        run = self._running.pop(trial.id, None)
        self._ended += 1
        compared = ending.outcome in (Outcome.STOPPED_ASHA, Outcome.STOPPED_MEDIAN)  # their reason names the score
        score = "" if run is None or compared or run.best == -math.inf else f"; best score {run.best:.5g}"
        self.say(f"{trial.id} {ending.outcome}: {printable(ending.why)}{score}{self._suffix(trial)}")

    def failed(self, trial: Trial, why: str, where: object) -> None:
        """A trial has ended in an error."""
        self._running.pop(trial.id, None)
        self._ended += 1
        self.say(f"{trial.id} error: {why}; see {where}{self._suffix(trial)}")

    def left(self, trial: Trial) -> None:
        """A trial's process has ended, but not the trial."""
        self._running.pop(trial.id, None)

    def tick(self) -> None:
        """Print the overview if it is due."""
        if time.monotonic() - self._last_status >= STATUS_INTERVAL_S:
            self._last_status = time.monotonic()
            self.say(self.status())

    def status(self) -> str:
        """The overview: one line, and one for each running trial."""
        parts = [f"{len(self._running)} running", f"{len(self._waiting)} waiting", f"{self._ended} ended"]
        bests = []
        for environment in self._environments:
            best = self._leaders.get(environment)
            if best is not None:
                where = f"{environment} " if len(self._environments) > 1 else ""
                bests.append(f"{where}{best[0]:.5g} ({best[1].id})")
        if bests:
            parts.append(f"best {', '.join(bests)}")
        running = [
            (run.trial.epochs - run.epoch, self._seconds_per_epoch.get(run.trial.id)) for run in self._running.values()
        ]
        left = eta(running, [trial.epochs for trial in self._waiting.values()], self._concurrent)
        if left is not None:
            parts.append(f"at most {format_duration(left)} left")
        lines = [" · ".join(parts)]
        for run in self._running.values():
            score = f"score {run.score:.5g} (best {run.best:.5g})"
            if math.isnan(run.score):
                since = format_duration(time.monotonic() - run.since)
                score = f"no evaluation in {since}: {BEFORE_FIRST}" if run.epoch == 0 else "no evaluation yet"
            lines.append(
                f"    {run.trial.id}  epoch {run.epoch:>4}/{run.trial.epochs}  {score}  {self._name(run.trial)}"
            )
        return "\n".join(lines)

    def _leads(self, score: float, trial: Trial) -> bool:
        """Whether a score is the best in its trial's environment so far; then it is remembered."""
        before = self._leaders.get(trial.environment)
        if before is not None and score <= before[0]:
            return False
        self._leaders[trial.environment] = score, trial
        return True

    def _name(self, trial: Trial) -> str:
        return f"{printable(trial.variant)} seed={trial.seed}{self._suffix(trial)}"

    def _suffix(self, trial: Trial) -> str:
        """The trial's attempt in parentheses, if it is not the first."""
        return self._attempts.get(trial.id, FIRST).suffix
