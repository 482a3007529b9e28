"""The trainer: runs the epochs of an algorithm, with evaluation, logs and checkpoints in one folder."""

import math
import time
from collections.abc import Collection
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from msk_ray.algorithms import algorithm_class
from msk_ray.config import Config, dump_yaml, overlay, parse_config, parse_recorded
from msk_ray.envs import make_env
from msk_ray.errors import CheckpointError, StorageError
from msk_ray.experiment.damage import Damage, describe_damages
from msk_ray.experiment.layout import METRICS_FILE
from msk_ray.experiment.metrics import SCORE, read_metrics
from msk_ray.files import remove_stale, write_bytes
from msk_ray.training.checkpoint import (
    epoch_checkpoints,
    milestone_path,
    newest_valid_checkpoint,
    prune_checkpoints,
    read_checkpoint,
    write_checkpoint,
)
from msk_ray.training.evaluation import Evaluator
from msk_ray.training.loggers import TrialLog
from msk_ray.training.memory import named_out_of_memory
from msk_ray.training.threads import use_threads

# Settings that may differ between a checkpoint and the trial that continues from it.
_EXTENDABLE = {
    "trial": {"epochs", "checkpoint_interval", "keep_checkpoints", "loggers"},
    "physics": {"nconmax", "njmax"},  # buffer sizes, which an error may ask for; results do not depend on them
}
_MILESTONES = 8
"""Number of policies saved during training in addition to the first, for `visualize --progression`."""


class Trainer:
    """One trial in this process.

    Writes `config.yaml`, `metrics.jsonl`, `checkpoints/` and the files of its loggers under `logdir`. The checkpoints
    are the newest complete states, `best.pt` (until the first evaluation the untrained policy), and at about every
    eighth of training the policy (`policy_*.pt`). Call `run_epoch` until `finished`; call `restore_latest` first to
    continue from the newest complete checkpoint, which on CPU gives exactly the metrics of an uninterrupted run.

    Attributes:
        env: the worlds used for training.
        algorithm: the algorithm that trains in them.
        epoch: number of epochs done.
        best_score: highest evaluation score of the trained policy so far, -inf before the first; that of `best.pt`.

    Raises:
        ConfigError, DeviceError, UnsupportedModelError, StorageError, SimulationError: as their messages say.
    """

    def __init__(self, config: Config, logdir: Path, device: str) -> None:
        algorithm = algorithm_class(config)
        self._log = TrialLog(logdir, config)
        self.config = config
        self.logdir = logdir
        self.epoch = 0
        self.env_steps = 0
        self.best_score = -math.inf
        self._seconds = 0.0
        try:
            self.checkpoints.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot create {self.checkpoints}: {error.strerror or error}") from error
        for folder in (logdir, self.checkpoints):
            remove_stale(folder)
        if not epoch_checkpoints(self.checkpoints):
            # Otherwise the file describes what those were trained under, until one of them is resumed.
            self._write_config()
        self._device = device
        use_threads(config)
        with self._memory():
            self.env = make_env(
                config.env,
                config.physics,
                config.env.nworld,
                device,
                config.trial.seed,
                differentiable=config.algorithm_settings.differentiates,
                randomize=True,
            )
            self.algorithm = algorithm(config, self.env)
            self.evaluator = Evaluator(config, device)
        self._damages: tuple[Damage, ...] = ()

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.logdir / "checkpoints"

    @property
    def best_checkpoint(self) -> Path:
        """Checkpoint of the policy with the best evaluation score."""
        return self.checkpoints / "best.pt"

    @property
    def finished(self) -> bool:
        """Whether all epochs are done."""
        return self.epoch >= self.config.trial.epochs

    def run_epoch(self) -> dict[str, float]:
        """Train one epoch, evaluate and checkpoint when due, and write one row of metrics.

        Returns:
            The row: `epoch`, `env_steps`, `seconds` of training so far, `env_steps_per_s`, `train/*`, `grad/*`,
            `time/*`, `physics/*`, and on evaluation epochs `eval/*`.

        Raises:
            SimulationError: the gradient or the physics failed, or the device ran out of memory; the last checkpoint
                stays unchanged.
            CheckpointError: in the first epoch, if the checkpoint to start from is missing, incomplete, or does not
                fit.
        """
        with self._memory():
            return self._run_epoch()

    def _memory(self) -> AbstractContextManager[None]:
        length = self.config.algorithm_settings.length
        other = [] if length is None else [f"{self.config.algorithm_section}.{length}"]
        return named_out_of_memory(self._device, self.config.env.nworld, "env.nworld", *other)

    def _run_epoch(self) -> dict[str, float]:
        if self.epoch == 0:
            self._start_from(self.config.trial.start_from)
            self._evaluate_initial()
        started = time.perf_counter()
        self.env.begin_epoch(self.epoch)
        result = self.algorithm.update(self.epoch)
        self.epoch += 1
        self.env_steps += result.env_steps
        elapsed = time.perf_counter() - started
        metrics = dict(result.metrics)
        if self.epoch % self.config.evaluation.interval == 0 or self.finished:
            metrics |= self._evaluate()
        self._seconds += time.perf_counter() - started
        row = self._row(metrics | {"env_steps_per_s": result.env_steps / elapsed})
        self._log.write(row)
        if self.epoch % self.config.trial.checkpoint_interval == 0 or self.finished:
            self.save()
        return row

    def save(self) -> Path:
        """Write a checkpoint of everything and return its path; an existing one is kept."""
        path = self.checkpoints / f"epoch_{self.epoch:06d}.pt"
        self._write(path)
        prune_checkpoints(self.checkpoints, self.config.trial.keep_checkpoints)
        return path

    def restore(self, path: Path, changed: Collection[str] = ()) -> None:
        """Continue from a checkpoint.

        Args:
            path: the checkpoint.
            changed: dotted settings that may differ from those it was written under.

        Raises:
            CheckpointError: it is missing, incomplete, or was written under other settings.
        """
        state = _expect(path, read_checkpoint(path))
        difference = _first_difference(
            parse_recorded(state["config"], f"{path}: its settings").as_dict(), self.config.as_dict(), changed
        )
        if difference:
            raise CheckpointError(
                f"{path} was written under other settings: {difference}; use those, or start another trial"
            )
        if state["epoch"] > self.config.trial.epochs:
            raise CheckpointError(
                f"{path} has {state['epoch']} epochs already: set trial.epochs to the new total, not "
                f"{self.config.trial.epochs}"
            )
        self._write_config()
        self.algorithm.load_state_dict(_to_device(state["algorithm"], self.env.device))
        self.epoch, self.env_steps = state["epoch"], state["env_steps"]
        self._seconds = state["seconds"]
        self._damages = self._log.rewind(self.epoch)
        self.best_score = self._trained_best(state["best_score"])

    def _trained_best(self, recorded: float) -> float:
        """A checkpoint's best score; -inf if it is the score of the untrained policy, which older versions counted.

        Then `best.pt` is the untrained policy, and the next evaluation replaces it.
        """
        rows = read_metrics(self.logdir / METRICS_FILE)
        untrained = [row.get(SCORE) for row in rows if row["epoch"] == 0]
        trained = [row.get(SCORE) for row in rows if row["epoch"] > 0]
        return -math.inf if recorded in untrained and recorded not in trained else recorded

    def restore_latest(self) -> tuple[Path | None, list[str]]:
        """Continue from the newest complete checkpoint, or from the start if there is none.

        Returns:
            Its path or None, and a line on each newer checkpoint that is incomplete and on damaged metrics.
        """
        path, faults = newest_valid_checkpoint(self.checkpoints)
        if path is not None:
            self.restore(path)
        else:
            self._write_config()
            # An attempt that died before its first checkpoint may have left rows, the last of them incomplete.
            self._damages = self._log.rewind(-1)
        return path, [*faults, *describe_damages(self._damages, self.logdir)]

    def _write_config(self) -> None:
        write_bytes(self.logdir / "config.yaml", dump_yaml(self.config.as_dict()).encode())

    def close(self) -> None:
        """Flush the logs."""
        self._log.close()

    def _start_from(self, path: str | None) -> None:
        if path is None:
            return
        state = read_checkpoint(Path(path))
        try:
            self.algorithm.start_from(_to_device(state["algorithm"]["modules"], self.env.device))
        except (KeyError, TypeError, RuntimeError) as error:
            what = str(error).splitlines()[-1].strip()
            raise CheckpointError(
                f"trial.start_from: {path} does not fit this trial ({what}): give a checkpoint of the same env, "
                "algorithm and networks"
            ) from error

    def _evaluate_initial(self) -> None:
        self._log.write(self._row(self._evaluate()))

    def _evaluate(self) -> dict[str, float]:
        started = time.perf_counter()
        figures = self.evaluator.run(self.algorithm.policy)
        if self.epoch == 0:
            # Only to look at; it has no score, so that any trained policy replaces it.
            self._write(self.best_checkpoint)
        elif figures["score"] > self.best_score:
            self.best_score = figures["score"]
            self._write(self.best_checkpoint)
        if self._at_milestone():
            self._write_policy(figures["score"])
        row = {f"eval/{name}": value for name, value in figures.items()}
        if math.isfinite(self.best_score):
            row["eval/best_score"] = self.best_score
        return row | {"time/evaluation_s": time.perf_counter() - started}

    def _at_milestone(self) -> bool:
        """Whether this evaluation is the first one after another eighth of the trial, or the one before training.

        This depends only on the epoch, so that a resumed trial saves the same ones.
        """
        epochs, previous = self.config.trial.epochs, self.epoch - self.config.evaluation.interval
        return self.epoch == 0 or _MILESTONES * self.epoch // epochs > _MILESTONES * previous // epochs

    def _write_policy(self, score: float) -> None:
        state = {
            "config": self.config.as_dict(),
            "epoch": self.epoch,
            "env_steps": self.env_steps,
            "algorithm": {"modules": self.algorithm.policy_state_dict()},
        }
        facts = {"epoch": self.epoch, "score": _finite(score)}
        write_checkpoint(milestone_path(self.checkpoints, self.epoch), state, facts)

    def _row(self, metrics: dict[str, float]) -> dict[str, float]:
        return {"epoch": self.epoch, "env_steps": self.env_steps, "seconds": self._seconds, **metrics}

    def _write(self, path: Path) -> None:
        state = {
            "config": self.config.as_dict(),
            "epoch": self.epoch,
            "env_steps": self.env_steps,
            "seconds": self._seconds,
            "best_score": self.best_score,
            "algorithm": self.algorithm.state_dict(),
        }
        write_checkpoint(path, state, {"epoch": self.epoch, "best_score": _finite(self.best_score)})


def precompile(config: Config, device: str, logdir: Path) -> None:
    """Compile every kernel of this configuration into Warp's cache, by running the shortest epoch of its algorithm.

    It uses few worlds: kernels do not depend on their number, and the trial itself reports a device that is too small.
    """
    TrialLog(logdir, config)  # a missing logger must be reported before the trials start
    own = config.algorithm_settings.shortest()
    tiny = {
        "env.nworld": 2,
        **{f"{config.algorithm_section}.{key}": value for key, value in own.items()},
        "evaluation.steps": 1,
        "evaluation.nworld": 2,
        "trial.epochs": 1,
        "trial.start_from": None,
        "trial.loggers": [],
    }
    trainer = Trainer(parse_config(overlay(config.as_dict(), tiny), "a short epoch"), logdir, device)
    trainer.run_epoch()
    trainer.close()


def _expect(path: Path, state: dict[str, Any]) -> dict[str, Any]:
    """The complete state of a trial, with everything needed to continue."""
    missing = [
        key for key in ("config", "epoch", "env_steps", "seconds", "best_score", "algorithm") if key not in state
    ]
    if missing:
        raise CheckpointError(f"{path} holds no trial to continue: {', '.join(missing)} missing")
    return state


def _finite(score: float) -> float | None:
    """A score for a checkpoint's facts, which cannot hold infinity: None before the first evaluation."""
    return score if math.isfinite(score) else None


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


def _to_device(value: Any, device: Any) -> Any:
    """Nested containers with every tensor moved to a device."""
    if isinstance(value, dict):
        return {k: _to_device(v, device) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_to_device(v, device) for v in value]
    return value.to(device) if hasattr(value, "to") else value
