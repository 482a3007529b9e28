"""Run one trial from its current state to its end, also after its process was killed. Independent of Ray, for use in a
debugger."""

import bdb
import math
import traceback
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from msk_ray.config import Config
from msk_ray.errors import (
    ConfigError,
    Failure,
    MskRayError,
    RankLost,
    SimulationError,
    StorageFailure,
    storage_failure,
)
from msk_ray.experiment.attempts import FIRST, Attempt, load_attempt, read_attempt
from msk_ray.experiment.damage import DamagedFile
from msk_ray.experiment.layout import ABANDONED, ERROR_FILE
from msk_ray.experiment.metrics import Evaluation, evaluations_of, read_rows
from msk_ray.experiment.outcomes import Ending, Outcome, load_ending, write_ending
from msk_ray.experiment.trial import Trial
from msk_ray.files import write_text
from msk_ray.signals import current
from msk_ray.sweep.rules.stop_rule import History
from msk_ray.sweep.rules.stopping import StopSpec
from msk_ray.tune.failures import described, repeats


class TrainerLike(Protocol):
    """The part of `msk_ray.training.Trainer` that a trial uses."""

    epoch: int
    best_score: float

    @property
    def finished(self) -> bool: ...

    def run_epoch(self) -> dict[str, float]: ...

    def save(self) -> Path: ...

    def discard_checkpoint(self) -> None: ...

    def restore(self, path: Path, changed: Collection[str]) -> None: ...

    def restore_latest(self) -> tuple[Path | None, list[str]]: ...

    def close(self) -> None: ...


MakeTrainer = Callable[[Config, Path, str], TrainerLike]
"""(config, folder, device) → trainer."""
Precompile = Callable[[Config, str, Path], None]
"""Compiles a config's kernels for a device; other files go to the folder."""


def make_trainer(config: Config, folder: Path, device: str) -> TrainerLike:
    """`msk_ray.training.make_trainer`, imported by the calling process, so that the driver does not load torch."""
    from msk_ray import training

    return training.make_trainer(config, folder, device)


def precompile(config: Config, device: str, folder: Path) -> None:
    """`msk_ray.training.precompile`, likewise."""
    from msk_ray import training

    training.precompile(config, device, folder)


@dataclass(frozen=True)
class MemberCheckpoint:
    """The checkpoint from which a population's member continues: its own, or a better member's."""

    path: Path
    changed: frozenset[str]
    """Dotted settings that may differ from the checkpoint's."""


@dataclass(frozen=True)
class Hooks:
    """Callbacks by which the caller follows a trial and can pause it."""

    on_epoch: Callable[[Mapping[str, float]], None] = field(default=lambda row: None)
    """Called with every row of metrics."""
    on_evaluation: Callable[[Evaluation, bool, TrainerLike], None] = field(default=lambda e, last, trainer: None)
    """Called after each evaluation with the evaluation, whether the trial has ended, and the trainer."""
    pause: Callable[[], bool] = field(default=lambda: False)
    """Called before every epoch; True makes the trial save itself and return."""


def run_trial(
    trial: Trial,
    folder: Path,
    device: str,
    stop: StopSpec,
    make_trainer: MakeTrainer,
    hooks: Hooks,
    member_checkpoint: MemberCheckpoint | None = None,
    may_halve: bool = False,
) -> Ending | None:
    """Train until the trial ends, at its last epoch or by one of its own rules.

    Continues from `member_checkpoint`, or else from the newest complete checkpoint in `folder`. The ending is written
    to `folder`, which must exist: a trial whose folder was moved does not start again.

    Args:
        may_halve: whether the trial may restart once with half its worlds if it runs out of memory. A trial that
            already has half of them continues with these in any case.

    Returns:
        How it ended. None if it was paused, or must run again in a new process because it is out of memory; then
        `folder` holds the next attempt.

    Raises:
        StorageFailure: the disk is full, or the disk or folder is gone; the trial can continue once it is back.
        RankLost: one of the trial's processes has died; the trial may be retried.
        KeyboardInterrupt: this process was asked to stop.
        Exception: an error of the machine, which another process may not meet. Its traceback is written to `error.txt`,
            and the trial may be retried.
    """
    if not folder.is_dir():
        raise StorageFailure(f"{folder} does not exist: moved, removed or not mounted")
    try:
        done = load_ending(folder)
    except DamagedFile as error:
        print(f"{error}; continuing as if it had not ended", flush=True)
        done = None
    if done is not None:
        return done
    # This file is about the latest attempt; the trial's output keeps earlier errors.
    (folder / ERROR_FILE).unlink(missing_ok=True)
    attempt = FIRST
    try:
        # The process that recorded the attempt may have died before starting it.
        attempt = _attempt_in(folder).begin(folder)
        if attempt.reduction is not None:
            print(attempt, flush=True)
        ending = _train(attempt.effective(trial), folder, device, stop, make_trainer, hooks, member_checkpoint)
    except SimulationError as error:
        if error.failure is Failure.OUT_OF_MEMORY:
            ending = _out_of_memory(trial, folder, str(error), attempt, may_halve)
        else:
            ending = Ending(Outcome(error.failure.value), str(error))
    except (StorageFailure, RankLost, bdb.BdbQuit):
        # The trial has not ended: it can continue once the disk has space, in new processes, or after debugging.
        raise
    except MskRayError as error:
        ending = Ending(Outcome.ERROR, str(error))
    except (Exception, SystemExit, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt) and current():
            raise
        traceback.print_exc()
        write_text(folder / ERROR_FILE, traceback.format_exc())
        if storage_failure(error) is not None or not repeats(error):
            raise
        ending = Ending(Outcome.ERROR, described(error))
    if ending is not None:
        write_ending(folder, ending)
    return ending


def _attempt_in(folder: Path) -> Attempt:
    try:
        return load_attempt(folder)
    except DamagedFile as error:
        advice = (
            'the number of worlds is unknown: write {"asked": N, "worlds": HALF, "why": "", "cleared": '
            "true} into it and add --resume --retry error"
        )
        raise DamagedFile(error.damage, advice) from None


def _out_of_memory(trial: Trial, folder: Path, why: str, attempt: Attempt, may_halve: bool) -> Ending | None:
    """The ending of a trial that does not fit on its device; None if there will be another attempt."""
    if attempt.reduction is None and not may_halve:
        return Ending(Outcome.OUT_OF_MEMORY, why)
    try:
        following = attempt.next(trial, why)
    except ConfigError as fault:
        return Ending(Outcome.OUT_OF_MEMORY, f"{why}; {fault}")
    following.begin(folder)
    print(f"{why}\nthe trial restarts with {following}; its work so far is in {ABANDONED}/", flush=True)
    return None


def _train(
    trial: Trial,
    folder: Path,
    device: str,
    stop: StopSpec,
    make_trainer: MakeTrainer,
    hooks: Hooks,
    member_checkpoint: MemberCheckpoint | None,
) -> Ending | None:
    trainer = make_trainer(trial.config, folder, device)
    try:
        if member_checkpoint is not None:
            trainer.restore(member_checkpoint.path, member_checkpoint.changed)
            # The best score belongs to this trial's best.pt; with a better member's score, it would never be replaced.
            own = [e.score for e in evaluations_of(read_rows(folder)) if math.isfinite(e.score)]
            trainer.best_score = max(own, default=-math.inf)
        else:
            done = max((int(row["epoch"]) for row in read_rows(folder)), default=0)
            path, faults = trainer.restore_latest()
            for fault in faults:
                print(f"skipped: {fault}", flush=True)
            if path is not None:
                print(f"continuing from {path}", flush=True)
            elif done:
                print(f"starting again: there is no complete checkpoint of the {done} epochs it had run", flush=True)
            else:
                print("starting", flush=True)
        note = str(read_attempt(folder))
        if note:
            # Restoring has rewritten the settings; note the attempt for people who read only this file.
            settings = folder / "config.yaml"
            write_text(settings, f"# {note} asked for\n{settings.read_text(encoding='utf-8')}")
        ending = _loop(trial, folder, stop, trainer, hooks)
        if ending is not None and ending.outcome is Outcome.NONFINITE:
            # A retry has to repeat the epoch; from its checkpoint it would only find the same row again.
            trainer.discard_checkpoint()
        return ending
    finally:
        trainer.close()


def _loop(trial: Trial, folder: Path, stop: StopSpec, trainer: TrainerLike, hooks: Hooks) -> Ending | None:
    if trainer.epoch > 0:
        rows = [row for row in read_rows(folder) if row["epoch"] <= trainer.epoch]
        seen = evaluations_of(rows)
        ending = stop.ending(History(rows[-1], seen, trial.epochs, rows[-1]["seconds"])) if rows else None
        if seen:
            # The process may have died after the checkpoint and before its result; a repeated result is ignored.
            hooks.on_evaluation(seen[-1], ending is not None, trainer)
        if ending is not None:
            return ending
    evaluations: list[Evaluation] | None = None
    while not hooks.pause():
        row = trainer.run_epoch()
        hooks.on_epoch(row)
        evaluation = Evaluation.from_row(row)
        if evaluations is None:
            # Read from the file, which also has the evaluation before the first epoch.
            evaluations = evaluations_of([r for r in read_rows(folder) if r["epoch"] <= row["epoch"]])
        elif evaluation is not None:
            evaluations.append(evaluation)
        ending = stop.ending(History(row, evaluations, trial.epochs, row["seconds"]))
        if ending is not None and ending.outcome is Outcome.NONFINITE:
            return ending
        if evaluation is not None:
            if ending is not None:
                # Write the ending first: the receiver of the last evaluation must find it.
                write_ending(folder, ending)
            hooks.on_evaluation(evaluation, ending is not None, trainer)
        if ending is not None:
            return ending
    if trainer.epoch > 0:
        trainer.save()
    return None
