"""The trainer: runs the epochs of an algorithm, with evaluation, logs and checkpoints in one folder."""

import math
import time
import warnings
from collections.abc import Collection
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from msk_ray.algorithms import algorithm_class
from msk_ray.config import Config, ExecutionConfig, dump_yaml, overlay, parse_config, parse_recorded
from msk_ray.errors import CheckpointError, ConfigError, SimulationError, StorageError
from msk_ray.experiment.damage import Damage, describe_damages
from msk_ray.experiment.layout import METRICS_FILE
from msk_ray.experiment.metrics import read_metrics
from msk_ray.files import remove_stale, write_bytes
from msk_ray.group import ALONE, Group
from msk_ray.metrics import SCORE
from msk_ray.step.autograd.simulation import resolve_device
from msk_ray.training.checkpoint import (
    epoch_checkpoints,
    newest_valid_checkpoint,
    prune_checkpoints,
    read_checkpoint,
    write_checkpoint,
)
from msk_ray.training.evaluation import Evaluator
from msk_ray.training.learner import check_generators, load_state, make_algorithm, memory_errors_named, start_from
from msk_ray.training.loggers import TrialLog
from msk_ray.training.machine import machine_differences, record_machine
from msk_ray.training.scoring import Scoring, finite_or_none
from msk_ray.training.trial_folder import TrialFolder

# Settings that may differ between a checkpoint and the trial that continues from it.
_EXTENDABLE = {"trial": {"epochs"}, "execution": set(ExecutionConfig.model_fields)}
MOST_TOGETHER = 32
"""Policies scored together on a GPU."""


class Trainer(TrialFolder):
    """One trial in this process.

    Writes `config.yaml`, `metrics.jsonl`, `checkpoints/` and the files of its loggers under `logdir`. The checkpoints
    are the newest complete states, `best.pt` (the untrained policy until the first evaluation), and a policy
    (`policy_*.pt`) at about every eighth of the training. Call `run_epoch` until `finished`, after `restore_latest` to
    continue from the newest complete checkpoint, which on CPU gives exactly the metrics of an uninterrupted run.

    Args:
        config: every setting.
        logdir: the folder.
        device: "cpu" or "cuda:N".
        together: number of policies to score at the same time. On a GPU, 16 take hardly longer than one. A policy then
            waits until there are that many, or two minutes have passed, or training ends; its row gets the score later.
            Final scores and best.pt are the same. A logger without `write_late` forces 1.
        group: the processes that train the trial. This one is the first, and tells the others, which run `follow`,
            every call in which all take part. `make_trainer` starts them.

    Attributes:
        env: the worlds used for training in this process.
        algorithm: the algorithm that trains in them.
        epoch: number of epochs done.
        together: number of policies that are scored at the same time.

    Raises:
        ConfigError, DeviceError, UnsupportedModelError, StorageError, SimulationError: as their messages say.
    """

    def __init__(self, config: Config, logdir: Path, device: str, together: int = 1, group: Group = ALONE) -> None:
        if config.execution.gpus != group.size:
            raise ConfigError(
                f"execution.gpus {config.execution.gpus}: a Trainer is one process; start this trial with "
                "msk_ray.train or msk_ray.training.make_trainer"
            )
        # Report missing files before writing anything.
        algorithm_class(config)
        resolve_device(device)
        super().__init__(config, logdir)
        self._log = TrialLog(logdir, config)
        self._group = group
        self.env_steps = 0
        self._seconds = 0.0
        try:
            self.checkpoints.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot create {self.checkpoints}: {error.strerror or error}") from error
        for folder in (logdir, self.checkpoints):
            remove_stale(folder)
        if not epoch_checkpoints(self.checkpoints):
            # With checkpoints, the file keeps describing how they were trained, until one of them is resumed.
            self._write_config()
            record_machine(logdir, device, config.execution.deterministic)
        self._device = device
        self.together = min(together, self._evaluations) if self._log.takes_late else 1
        with self._memory_errors_named():
            self.algorithm = make_algorithm(config, device, group)
            self.env = self.algorithm.env
            self.evaluator = Evaluator(config, device, policies=self.together)
            self.evaluator.check_kept_worlds()
        self._scoring = Scoring(self, self.algorithm, self.evaluator, self._log, self.together)
        self._damages: tuple[Damage, ...] = ()
        self._unreadable: list[str] = []

    @property
    def best_score(self) -> float:
        """Highest evaluation score of the trained policy so far, -inf before the first; that of `best.pt`."""
        return self._scoring.best

    @best_score.setter
    def best_score(self, score: float) -> None:
        self._scoring.best = score

    @property
    def _evaluations(self) -> int:
        """Number of evaluations in the trial: before training, at intervals, and at its end."""
        return 1 + math.ceil(self.config.trial.epochs / self.config.evaluation.interval)

    def run_epoch(self) -> dict[str, float]:
        """Train one epoch, evaluate and checkpoint when due, and write one row of metrics.

        Returns:
            The row: `epoch`, `env_steps`, `seconds` of training so far, `env_steps_per_s`, `train/*`, `grad/*`,
            `time/*`, `physics/*`, and on evaluation epochs `eval/*`, unless the policy waits for its score.

        Raises:
            SimulationError: the gradient or the physics failed, or the device ran out of memory; the last checkpoint
                stays unchanged.
            CheckpointError: in the first epoch, if the checkpoint to start from is missing, incomplete, or does not
                fit.
        """
        with self._memory_errors_named():
            if self.epoch == 0:
                self._begin()
        started = time.perf_counter()
        try:
            with self._memory_errors_named():
                self._group.send_order("update", self.epoch)
                result = self.algorithm.run_epoch(self.epoch)
        except SimulationError:
            self._score_despite_failure()
            raise
        self.epoch += 1
        self.env_steps += result.env_steps
        elapsed = time.perf_counter() - started
        metrics = dict(result.metrics)
        if self.epoch % self.config.evaluation.interval == 0 or self.finished:
            with self._memory_errors_named():
                metrics |= self._scoring.evaluate(self.epoch, self._state, last=self.finished)
        self._seconds += time.perf_counter() - started
        row = self._row(metrics | {"env_steps_per_s": result.env_steps / elapsed})
        self._log.write(row)
        if self.epoch % self.config.execution.checkpoint_interval == 0 or self.finished:
            self.save()
        return row

    def score_waiting(self) -> None:
        """Score the waiting policies, for example because training stops here.

        Raises:
            SimulationError: as for `run_epoch`.
        """
        started = time.perf_counter()
        with self._memory_errors_named():
            self._scoring.score_waiting()
        self._seconds += time.perf_counter() - started

    def _memory_errors_named(self) -> AbstractContextManager[None]:
        return memory_errors_named(self.config, self._device)

    def save(self) -> Path:
        """Write a checkpoint of everything and return its path; an existing one is kept."""
        path = self._checkpoint
        write_checkpoint(path, self._state(), {"epoch": self.epoch, "best_score": finite_or_none(self.best_score)})
        prune_checkpoints(self.checkpoints, self.config.execution.keep_checkpoints)
        return path

    def discard_checkpoint(self) -> None:
        """Remove the checkpoint of the current epoch, if there is one."""
        self._checkpoint.unlink(missing_ok=True)

    @property
    def _checkpoint(self) -> Path:
        return self.checkpoints / f"epoch_{self.epoch:06d}.pt"

    def restore(self, path: Path, changed: Collection[str] = ()) -> None:
        """Continue from a checkpoint.

        Args:
            path: the checkpoint.
            changed: dotted settings that may differ from those it was written under.

        Raises:
            CheckpointError: it is missing, incomplete, was written under other settings, or on another kind of device.
        """
        state = _expect(path, read_checkpoint(path))
        self._check_continues(path, state, changed)
        self._write_config()
        self._group.send_order("load", str(path))
        load_state(self.algorithm, state)
        self.epoch, self.env_steps = state["epoch"], state["env_steps"]
        self._seconds = state["seconds"]
        self._damages = self._log.rewind(self.epoch)
        rows = read_metrics(self.logdir / METRICS_FILE)
        self._unreadable = self._scoring.rewind(self.epoch, {row["epoch"] for row in rows if SCORE in row})
        # A policy may have been scored after the checkpoint.
        scores = (row[SCORE] for row in rows if row["epoch"] > 0 and row.get(SCORE) is not None)
        self.best_score = max(state["best_score"], *scores, -math.inf)

    def _check_continues(self, path: Path, state: dict[str, Any], changed: Collection[str]) -> None:
        """Raise, as for `restore`, if a checkpoint does not fit this trial; warn if bits will differ."""
        recorded = parse_recorded(state["config"], f"{path}: its settings")
        difference = _first_difference(recorded.as_dict(), self.config.as_dict(), changed)
        if difference:
            raise CheckpointError(
                f"{path} was written under other settings: {difference}; use those, or start another trial"
            )
        if state["epoch"] > self.config.trial.epochs:
            raise CheckpointError(
                f"{path} has {state['epoch']} epochs already: set trial.epochs to the new total, not "
                f"{self.config.trial.epochs}"
            )
        check_generators(path, state["algorithm"]["env_generator"], self.algorithm.env.device)
        if recomputed := _changed_rounding(recorded.execution, self.config.execution):
            warnings.warn(
                f"{path.name} was written with {recomputed}: the same to rounding, not to the bit", stacklevel=3
            )
        if moved := machine_differences(self.logdir, self._device):
            warnings.warn(f"{path.name} is of another machine, so bits will differ: {moved}", stacklevel=3)

    def restore_latest(self) -> tuple[Path | None, list[str]]:
        """Continue from the newest complete checkpoint, or from the start if there is none.

        Returns:
            Its path or None, and a line for each newer, incomplete checkpoint and for damaged metrics.
        """
        path, faults = newest_valid_checkpoint(self.checkpoints)
        if path is not None:
            self.restore(path)
        else:
            self._write_config()
            # An attempt that died before its first checkpoint may have left rows, the last of them incomplete.
            self._damages = self._log.rewind(-1)
            self._scoring.rewind(-1, ())
        return path, [*faults, *self._unreadable, *describe_damages(self._damages, self.logdir)]

    def _write_config(self) -> None:
        write_bytes(self.logdir / "config.yaml", dump_yaml(self.config.as_dict()).encode())

    def solver(self) -> str:
        """Text on the constraint solver: its kernels, and the size of the problem by which `auto` chooses them."""
        batch = self.env.sim.batch
        kernels = "one kernel (fused)" if batch.kernels.fused_solver else "mujoco_warp's kernels"
        return f"{kernels}, for {batch.mjm.nv} degrees of freedom and room for {batch.capacity.rows} rows per world"

    def remarks(self) -> list[str]:
        """Warnings: a line for each thing that made training worse or slower."""
        return self.algorithm.remarks()

    def close(self) -> None:
        """Flush the logs."""
        self._log.close()

    def _start_from(self, path: str | None) -> None:
        if path is not None:
            self._group.send_order("start_from", path)
            if missing := start_from(self.algorithm, path):
                warnings.warn(
                    f"trial.start_from: {path} has no {' and no '.join(missing)}, which begin untrained: the policy "
                    "may get worse before it gets better; a checkpoint of a whole trial has them",
                    stacklevel=2,
                )

    def _begin(self) -> None:
        """Evaluate and save the untrained policy. Its `best.pt` has no score, so that any trained policy replaces
        it."""
        self._start_from(self.config.trial.start_from)
        write_checkpoint(self.best_checkpoint, self._state(), {"epoch": 0, "best_score": None})
        self._log.write(self._row(self._scoring.evaluate(0, self._state, last=self.finished)))

    def _score_despite_failure(self) -> None:
        """Score the waiting policies although training has failed."""
        try:
            self.score_waiting()
        except SimulationError as error:
            warnings.warn(f"policies of epochs {self._scoring.waiting} have no score: {error}", stacklevel=2)

    def _row(self, metrics: dict[str, float]) -> dict[str, float]:
        return {"epoch": self.epoch, "env_steps": self.env_steps, "seconds": self._seconds, **metrics}

    def _state(self) -> dict[str, Any]:
        """The trial's complete state."""
        self._group.send_order("state_dict")
        return {
            "config": self.config.as_dict(),
            "epoch": self.epoch,
            "env_steps": self.env_steps,
            "seconds": self._seconds,
            "best_score": self.best_score,
            "sizes": (self.env.obs_size, self.env.action_size),
            "algorithm": self.algorithm.state_dict(),
        }


def precompile(config: Config, device: str, logdir: Path) -> None:
    """Compile every kernel of this configuration into Warp's cache, by running the shortest epoch of its algorithm.

    It uses few worlds: kernels do not depend on their number, and the trial itself reports a device that is too small.
    """
    TrialLog(logdir, config)  # report a missing logger before trials start
    own = config.algorithm_settings.shortest()
    tiny = {
        "env.nworld": 2,
        **{f"{config.algorithm_section}.{key}": value for key, value in own.items()},
        "evaluation.steps": 1,
        "evaluation.nworld": 2,
        "trial.epochs": 1,
        "execution.gpus": 1,
        "trial.start_from": None,
        "execution.loggers": [],
    }
    trainer = Trainer(parse_config(overlay(config.as_dict(), tiny), "a short epoch"), logdir, device)
    trainer.run_epoch()
    trainer.close()


def _changed_rounding(before: ExecutionConfig, now: ExecutionConfig) -> str:
    """`execution.gpus 2, now 1; …`: changed settings that change rounding; empty if none."""
    names = ("gpus", "threads", "deterministic", "solver_kernels", "jacobian")
    values = ((name, getattr(before, name), getattr(now, name)) for name in names)
    return "; ".join(f"execution.{name} {old}, now {new}" for name, old, new in values if old != new)


def _expect(path: Path, state: dict[str, Any]) -> dict[str, Any]:
    """The complete state of a trial, with everything needed to continue."""
    missing = [
        key for key in ("config", "epoch", "env_steps", "seconds", "best_score", "algorithm") if key not in state
    ]
    if missing:
        raise CheckpointError(f"{path} holds no trial to continue: {', '.join(missing)} missing")
    return state


def _first_difference(
    old: dict[str, Any], new: dict[str, Any], changed: Collection[str], prefix: str = ""
) -> str | None:
    """The first setting two configurations differ in, apart from those that may."""
    for key in {**old, **new}:
        if key in _EXTENDABLE.get(prefix.rstrip("."), set()) or f"{prefix}{key}" in changed:
            continue
        before, after = old.get(key), new.get(key)
        if isinstance(before, dict) and isinstance(after, dict):
            nested = _first_difference(before, after, changed, f"{prefix}{key}.")
            if nested:
                return nested
        elif before != after:
            return f"{prefix}{key} was {before!r}, now {after!r}"
    return None
