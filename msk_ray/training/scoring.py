"""Scores of a trial's policies, some of them later and together, and which policies are saved for them."""

import math
import time
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import torch

from msk_ray.algorithms import Algorithm
from msk_ray.experiment.metrics import HASH, read_rows
from msk_ray.metrics import BEST_SCORE
from msk_ray.networks import as_number, parameter_hash
from msk_ray.training.checkpoint import milestone_path, unscored_path, write_checkpoint
from msk_ray.training.evaluation import Evaluator
from msk_ray.training.loggers import TrialLog
from msk_ray.training.policy import SavedPolicy, Sizes
from msk_ray.training.policy_group import Policy
from msk_ray.training.trial_folder import TrialFolder
from msk_ray.training.unscored_policies import UnscoredPolicies

_MILESTONES = 8
"""Number of policies saved during training in addition to the first, for `visualize --progression`."""
_LONGEST_WAIT_S = 120.0
"""How long a policy waits to be scored together with others [s]."""


class Scoring:
    """Scores policies, and saves the best one and those at milestones.

    Args:
        folder: the trial's.
        algorithm: trains the policies.
        evaluator: scores them.
        log: gets the rows of those that had to wait.
        together: number of policies to score at the same time.

    Attributes:
        best: highest score of a trained policy so far, -inf before the first.
    """

    def __init__(
        self, folder: TrialFolder, algorithm: Algorithm, evaluator: Evaluator, log: TrialLog, together: int
    ) -> None:
        self._folder, self._config = folder, folder.config
        self._algorithm, self._evaluator, self._log = algorithm, evaluator, log
        self._together = together
        self._unscored = UnscoredPolicies(folder.checkpoints)
        self.best = -math.inf

    def evaluate(self, epoch: int, state: Callable[[], dict[str, Any]], *, last: bool) -> dict[str, float]:
        """Score the policy of an epoch together with the waiting ones, or let it wait. The last one never waits.

        Args:
            epoch: the epoch.
            state: gives the trial's complete state.
            last: whether training ends here.

        Returns:
            What is known for the epoch's row.
        """
        started = time.perf_counter()
        full = len(self._unscored.epochs) + 1 >= self._together
        if full or last or self._unscored.waited_s >= _LONGEST_WAIT_S:
            figures, others_s = self.score_waiting([self._algorithm.policy])
            metrics = self._record(epoch, figures[0], state, self._algorithm.parameter_hash())
            return metrics | {"time/evaluation_s": time.perf_counter() - started - others_s}
        self._unscored.add(state())
        return {"time/evaluation_s": time.perf_counter() - started}

    def score_waiting(self, own: Collection[Policy] = ()) -> tuple[list[dict[str, float]], float]:
        """Score policies together with the waiting ones, and rewrite the waiting ones' rows with their scores.

        Returns:
            The figures of `own`, and the share of the time that the others took [s].
        """
        started = time.perf_counter()
        waiting = list(self._unscored.epochs)
        states = {epoch: self._unscored.state(epoch) for epoch in waiting}
        policies = [*(self._waiting_policy(*item) for item in states.items()), *own]
        if not policies:
            return [], 0.0
        if waiting:
            # It has taken fewer steps than training to learn how large its buffers must be.
            self._evaluator.env.sim.reserve(self._algorithm.env.sim.capacity)
        figures = self._evaluator.run(policies)
        each_s = (time.perf_counter() - started) / len(policies)
        rows = {int(row["epoch"]): row for row in read_rows(self._folder.logdir)} if waiting else {}
        for epoch, scores in zip(waiting, figures, strict=False):
            state = states.pop(epoch)
            late = self._record(epoch, scores, partial(dict, state), parameter_hash(state["algorithm"]["modules"]))
            row = rows.get(epoch)
            if row is None:
                row = {key: state[key] for key in ("epoch", "env_steps", "seconds")}
            waited_s = row.get("time/evaluation_s", 0.0)
            self._log.write_late(row, late | {"time/evaluation_s": waited_s + each_s})
            self._unscored.remove(epoch)
        return figures[len(waiting) :], each_s * len(waiting)

    @property
    def waiting(self) -> list[int]:
        """Epochs of the policies that wait."""
        return self._unscored.epochs

    def rewind(self, epoch: int, scored: Collection[int]) -> list[str]:
        """Go back to an epoch, as for `UnscoredPolicies`."""
        return self._unscored.rewind(epoch, scored)

    def _waiting_policy(self, epoch: int, state: dict[str, Any]) -> Policy:
        path = unscored_path(self._folder.checkpoints, epoch)
        sizes, modules = Sizes(*state["sizes"]), state["algorithm"]["modules"]
        saved = SavedPolicy(path, self._config, epoch, state["env_steps"], "", modules, sizes)
        device = self._algorithm.env.device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            # Drawing weights must not change training's random numbers.
            return saved.on(self._evaluator.env)

    def _record(
        self, epoch: int, figures: dict[str, float], state: Callable[[], dict[str, Any]], parameters: str
    ) -> dict[str, float]:
        """Save the policy of an epoch if it is the best or a milestone. Returns the metrics of its evaluation.

        Args:
            epoch: the policy's epoch.
            figures: results of its evaluation.
            state: the trial's complete state then.
            parameters: digest of the trial's modules then.
        """
        score = figures["score"]
        if epoch > 0 and math.isfinite(score) and score > self.best:
            self.best = score
            facts = {"epoch": epoch, "best_score": score}
            write_checkpoint(self._folder.best_checkpoint, state() | {"best_score": score}, facts)
        if self._at_milestone(epoch):
            self._write_policy(state(), score)
        row = {f"eval/{name}": value for name, value in figures.items()} | {HASH: as_number(parameters)}
        if math.isfinite(self.best):
            row[BEST_SCORE] = self.best
        return row

    def _at_milestone(self, epoch: int) -> bool:
        """Whether an evaluation is the first one after another eighth of the trial, or the one before training.

        This depends only on the epoch, so that a resumed trial saves the same ones.
        """
        epochs, previous = self._config.trial.epochs, epoch - self._config.evaluation.interval
        return epoch == 0 or _MILESTONES * epoch // epochs > _MILESTONES * previous // epochs

    def _write_policy(self, state: dict[str, Any], score: float) -> None:
        parts = self._algorithm.policy_modules(self._algorithm.network)
        modules = {name: value for name, value in state["algorithm"]["modules"].items() if name in parts}
        facts_of_policy = {key: state[key] for key in ("config", "epoch", "env_steps", "sizes")}
        policy = {**facts_of_policy, "algorithm": {"modules": modules}}
        facts = {"epoch": state["epoch"], "score": finite_or_none(score)}
        write_checkpoint(milestone_path(self._folder.checkpoints, state["epoch"]), policy, facts)


def finite_or_none(score: float) -> float | None:
    """A score for a checkpoint's facts, which cannot hold infinity: None before the first evaluation."""
    return score if math.isfinite(score) else None
