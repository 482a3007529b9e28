"""What Ray Tune runs in a trial's process: `run_trial`, with results for Tune, gauges, and output in a file."""

import faulthandler
import json
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

from ray import tune
from ray.exceptions import RayActorError
from ray.tune.trainable import wrap_function

from msk_ray.config import overlay, parse_config
from msk_ray.errors import OwnershipLost, storage_failure
from msk_ray.experiment.attempts import read_attempt
from msk_ray.experiment.layout import DEVICE_FILE, HANG_FILE, OUTPUT_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import Evaluation
from msk_ray.experiment.ownership import acquire_for
from msk_ray.experiment.trial import Trial
from msk_ray.files import write_text
from msk_ray.sweep.search_trials import search_trial, write_params
from msk_ray.sweep.space import Space
from msk_ray.tune.devices import wait_for_memory
from msk_ray.tune.gauges import TrialGauges
from msk_ray.tune.output import limit_output, redirect_output
from msk_ray.tune.schedulers import BEST, METRIC
from msk_ray.tune.shared_trials import SharedTrials
from msk_ray.tune.trial_run import Hooks, MakeTrainer, MemberCheckpoint, TrainerLike, run_trial

MEMORY_LIMIT_S = 60.0
"""How long a trial waits for its GPU's memory to be free [s]."""


@dataclass(frozen=True)
class Job:
    """What a trial's process needs besides its Tune config."""

    experiment: Experiment
    space: Space
    base: dict[str, Any]
    trials: SharedTrials
    """None of them if a search suggests them."""
    device: str
    gpus: float
    """GPUs per trial, 0 on CPU."""
    make_trainer: MakeTrainer
    owner: str | None = None
    """Token of the experiment's owner; None without an owner."""

    @property
    def population(self) -> bool:
        """Whether trials exchange their state and settings."""
        return self.space.file.scheduler.exchanges

    def trial_of(self, config: Mapping[str, Any]) -> Trial:
        """The trial of a Tune config: `{id}`, `{id, params}` in a population, whose params change, or `{params}` from a
        search.
        """
        params = config.get("params", {})
        if "id" not in config:
            return search_trial(self.space, self.base, params)
        trial = self.trials[config["id"]]
        if not params:
            return trial
        settings = parse_config(overlay(trial.config.as_dict(), params), f"trial {trial.id}")
        return replace(trial, config=settings)


def make_trainable(job: Job, resources: dict[str, float]) -> type[tune.Trainable]:
    """The actor class that runs trials, with these resources."""

    def train(config: dict[str, Any]) -> None:
        trial = job.trial_of(config)
        folder = job.experiment.trial_folder(trial.id)
        try:
            if "id" in config:
                job.experiment.check_there(trial.id)
            else:
                job.experiment.make_trial_folder(trial.id)
                write_params(folder, config["params"])
            with _owned(folder, job):
                in_frame_named(trial.label, lambda: work(trial, folder))
        except _StoppedByTune:
            sys.exit(0)  # Tune ends a trial's thread like this
        except Exception as error:
            # On a full disk anything may fail first, even a line of output: tell the driver about the disk.
            # Likewise, report a missing folder, not the missing file in it.
            failure = storage_failure(error) or job.experiment.lost(trial.id)
            if failure is None or failure is error:
                raise
            raise failure from error

    def work(trial: Trial, folder: Path) -> None:
        output = folder / OUTPUT_FILE
        redirect_output(output)
        _record_device(folder / DEVICE_FILE, job.gpus)
        attempt = read_attempt(folder)
        if job.gpus:
            _wait_for_gpu(job.gpus)
        with (
            tempfile.TemporaryDirectory() as scratch,
            closing(TrialGauges(job.experiment.name, trial)) as gauges,
            _watchdog(folder, job.space.file.resources.hang_s) as watch,
        ):

            def on_epoch(row: Mapping[str, float]) -> None:
                watch.alive()
                limit_output(output)
                gauges.show(row)

            report = _report_with_checkpoint if job.population else _reporter(attempt.number)

            def on_evaluation(evaluation: Evaluation, ended: bool, trainer: TrainerLike) -> None:
                with watch.suspended():
                    try:
                        report(evaluation, ended, trainer)
                    except SystemExit as stopped:
                        raise _StoppedByTune from stopped

            hooks = Hooks(
                on_epoch=on_epoch,
                on_evaluation=on_evaluation,
                pause=job.experiment.asked_to_stop,
            )
            run_trial(
                trial,
                folder,
                job.device,
                job.space.file.stop,
                job.make_trainer,
                hooks,
                _member_checkpoint(job, Path(scratch)) if job.population else None,
                job.space.file.resources.halve_worlds_on_oom,
            )
            if read_attempt(folder).number > attempt.number:
                raise AnotherAttempt

    # For the function alone, Tune would create a class `ImplicitFunc`, and all actors would have that name.
    class TrialActor(wrap_function(tune.with_resources(train, resources))):  # type: ignore[misc]
        def __repr__(self) -> str:
            """Name of the actor in Ray's dashboard and lists, and before its lines of output."""
            return job.trial_of(self.config).label

    TrialActor.__qualname__ = TrialActor.__name__
    return TrialActor


class AnotherAttempt(RayActorError):
    """The trial goes on in a new process, because this one still holds the memory that it ran out of.

    Tune starts a new process for a trial whose process has failed, and does not count failures of processes that were
    preempted.
    """

    def __init__(self) -> None:
        super().__init__(preempted=True)

    def __reduce__(self) -> tuple[type["AnotherAttempt"], tuple[()]]:
        return AnotherAttempt, ()


class _StoppedByTune(BaseException):
    """Tune has ended this trial. Tune uses SystemExit, but so may a trial's own code."""


def in_frame_named(name: str, call: Callable[[], None]) -> None:
    """Call a function from a frame of this name, so that profilers and tracebacks show the trial."""

    def frame() -> None:
        call()

    frame.__code__ = frame.__code__.replace(co_name=name, co_qualname=name)
    frame()


@contextmanager
def _owned(folder: Path, job: Job) -> Iterator[None]:
    """Own a trial's folder on behalf of the driver that started this process.

    A process left over from an earlier driver, or on a node that Ray has given up, may still hold it until it notices.
    This process waits for that one.
    """
    if job.owner is None:
        yield
        return
    ownership = acquire_for(folder, job.experiment.path, job.owner, _leave)
    try:
        yield
    finally:
        ownership.release()


def _leave(lost: OwnershipLost) -> None:
    """Exit at once, because another process may already be writing to the same files."""
    os.write(2, f"{lost}; this process ends\n".encode())
    os._exit(lost.exit_code)


def _reporter(attempt: int) -> Callable[[Evaluation, bool, TrainerLike], None]:
    """Sends results to Tune without a checkpoint. Retried trials continue from their own folder, where an incomplete
    newest checkpoint is skipped; Ray would use it at every retry."""

    def report(evaluation: Evaluation, ended: bool, trainer: TrainerLike) -> None:
        tune.report(_figures(evaluation, ended, trainer.best_score, attempt))

    return report


def _report_with_checkpoint(evaluation: Evaluation, ended: bool, trainer: TrainerLike) -> None:
    """Sends results with a checkpoint, which Ray passes on to another member of the population."""
    path = trainer.save()
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(path, folder)
        figures = _figures(evaluation, ended, trainer.best_score, 1)
        tune.report(figures, checkpoint=tune.Checkpoint.from_directory(folder))


def _figures(evaluation: Evaluation, ended: bool, best: float, attempt: int) -> dict[str, Any]:
    return {
        METRIC: evaluation.score,
        BEST: best,
        "epoch": evaluation.epoch,
        "env_steps": evaluation.env_steps,
        "seconds": evaluation.seconds,
        "ended": ended,
        "attempt": attempt,
    }


def _member_checkpoint(job: Job, scratch: Path) -> MemberCheckpoint | None:
    """The checkpoint that Ray gives this trial, if any: its own after a crash, or a better member's."""
    checkpoint = tune.get_checkpoint()
    if checkpoint is None:
        return None
    checkpoint.to_directory(str(scratch))
    return MemberCheckpoint(min(scratch.glob("epoch_*.pt")), frozenset((*job.space.sampled, "trial.seed")))


class _Watch:
    """Writes this process's stacks to a file and ends it, if `alive` is not called for `limit_s`.

    faulthandler's timer runs in a thread outside Python, so it also catches calls that hang in a device driver.
    """

    def __init__(self, limit_s: float | None, file: TextIO | None) -> None:
        self._limit_s = limit_s
        self._file = file
        self.alive()

    def alive(self) -> None:
        """Restart the timer."""
        if self._limit_s is not None and self._file is not None:
            faulthandler.dump_traceback_later(self._limit_s, exit=True, file=self._file)

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Pause the timer in a block: sending a result waits for the driver, which may be suspended or busy."""
        faulthandler.cancel_dump_traceback_later()
        try:
            yield
        finally:
            self.alive()


@contextmanager
def _watchdog(folder: Path, limit_s: float | None) -> Iterator[_Watch]:
    """Watch this process during a block; if it hangs, its stacks are written to `hang.txt`."""
    path = folder / HANG_FILE
    path.unlink(missing_ok=True)
    if limit_s is None:
        yield _Watch(None, None)
        return
    with path.open("w", encoding="utf-8") as file:
        try:
            yield _Watch(limit_s, file)
        finally:
            faulthandler.cancel_dump_traceback_later()
    path.unlink()


def _wait_for_gpu(share: float) -> None:
    """Wait until the memory of earlier processes on this trial's GPUs is free."""
    import torch

    def free_share() -> float:
        shares = []
        for device in range(torch.cuda.device_count()):
            free, total = torch.cuda.mem_get_info(device)
            shares.append(free / total)
        return min(shares)

    left = wait_for_memory(min(share, 1.0), free_share, MEMORY_LIMIT_S)
    if left is not None:
        print(
            f"a GPU has only {left:.0%} of its memory free after {MEMORY_LIMIT_S:.0f} s: what else is using it?",
            flush=True,
        )


def _record_device(path: Path, gpus: float) -> None:
    """Record the trial's host, process and GPUs, as evidence that it had them to itself."""
    facts = {
        "host": platform.node(),
        "pid": os.getpid(),
        "began": time.time(),
        "visible": os.environ.get("CUDA_VISIBLE_DEVICES", ""),
        "count": 0,
        "name": "cpu",
    }
    if gpus:
        import torch

        facts |= {"count": torch.cuda.device_count(), "name": torch.cuda.get_device_name(0)}
    write_text(path, json.dumps(facts) + "\n")
