"""Which trial Tune runs next: from a list or a search, or again for another attempt.

Another attempt needs a new process, because the old one still holds its memory, and Tune starts a new process only for
a new trial. So if a trial's process has stopped before the trial's end and the folder holds another attempt, Tune gets
the trial again.
"""

import copy
import logging
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ray.tune.search import BasicVariantGenerator, Searcher

from msk_ray.experiment.attempts import read_attempt
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import last_figures, read_rows
from msk_ray.experiment.outcomes import read_ending
from msk_ray.sweep.search import Search
from msk_ray.tune.schedulers import BEST, METRIC

_log = logging.getLogger(__name__)

Identify = Callable[[Mapping[str, Any]], str]
"""The id of the trial that a Tune config stands for."""


class _Runs:
    """Tune's unfinished trials, and the Tune configs to run again."""

    def __init__(self, experiment: Experiment, identify: Identify) -> None:
        self._experiment = experiment
        self._identify = identify
        self._running: dict[str, tuple[Mapping[str, Any], int]] = {}
        self.again: deque[Mapping[str, Any]] = deque()

    def began(self, ray_id: str, config: Mapping[str, Any]) -> None:
        """Tune has got a trial."""
        attempt = read_attempt(self._experiment.trial_folder(self._identify(config)))
        self._running[ray_id] = config, attempt.number

    def ended(self, ray_id: str) -> Mapping[str, Any] | None:
        """Tune has finished with a trial. Returns its config, or None if the trial will run again."""
        config, attempt = self._running.pop(ray_id)
        folder = self._experiment.trial_folder(self._identify(config))
        if read_ending(folder) is None and read_attempt(folder).number > attempt:
            self.again.append(config)
            return None
        return config

    def __bool__(self) -> bool:
        """Whether a trial may still have to run again."""
        return bool(self._running or self.again)


class TrialList(BasicVariantGenerator):
    """Trials of a list, created by Tune's own generator from the parameter space."""

    def __init__(self, experiment: Experiment, identify: Identify, max_concurrent: int | None) -> None:
        # Tune does not limit concurrency for a given generator, so limit it here.
        super().__init__(max_concurrent=max_concurrent or 0)
        self._runs = _Runs(experiment, identify)
        self._given: Any = None
        self._asking = False
        self._stopped = False

    def add_configurations(self, experiments: Any) -> None:
        if self._given is None:
            self._given = experiments[0] if isinstance(experiments, list) else experiments
        super().add_configurations(experiments)

    def next_trial(self) -> Any:
        self._asking = True
        try:
            return self._next_trial()
        finally:
            self._asking = False

    def _next_trial(self) -> Any:
        trial = super().next_trial()
        if trial is None and self._runs.again and super().is_finished():
            more = copy.copy(self._given)
            more.spec = {**self._given.spec, "config": dict(self._runs.again.popleft()), "num_samples": 1}
            super().add_configurations([more])
            trial = super().next_trial()
        if trial is not None:
            self._runs.began(trial.trial_id, trial.config)
        return trial

    def on_trial_complete(self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False) -> None:
        super().on_trial_complete(trial_id, result, error)
        self._runs.ended(trial_id)

    def set_finished(self) -> None:
        super().set_finished()
        # Set by the generator at the end of its list, or by Tune when it stops.
        self._stopped = self._stopped or not self._asking

    def is_finished(self) -> bool:
        finished: bool = super().is_finished()
        return self._stopped or (finished and not self._runs)

    def save_to_dir(self, dirpath: str, session_str: str) -> None:
        """Does nothing: experiments are resumed from their trials' folders."""

    def has_checkpoint(self, dirpath: str) -> bool:
        return False


class Suggestions(Searcher):
    """Trials suggested by a search, which gets the best score of each ended trial, or its objectives."""

    def __init__(
        self,
        experiment: Experiment,
        identify: Identify,
        search: Search,
        begun: Sequence[Mapping[str, Any]],
        samples: int,
        objectives: Sequence[str] = (),
    ) -> None:
        """
        Args:
            experiment: the trials' experiment.
            identify: the id of the trial that a Tune config stands for.
            search: the search, with the results of ended trials.
            begun: earlier suggestions that have not ended; they run first.
            samples: number of trials, including those already started.
            objectives: metrics that the search gets instead of the best score, if any.
        """
        super().__init__(metric=METRIC, mode="max")
        self._runs = _Runs(experiment, identify)
        self._experiment, self._identify, self._objectives = experiment, identify, objectives
        self._search = search
        self._begun = deque(begun)
        self._left = samples
        self._best: dict[str, float] = {}

    def suggest(self, trial_id: str) -> Any:
        """The Tune config of the next trial; None if none should start now."""
        if self._runs.again:
            config = self._runs.again.popleft()
        elif self._left > 0:
            self._left -= 1
            config = {"params": dict(self._begun.popleft() if self._begun else self._search.ask())}
        else:
            return None if self._runs else Searcher.FINISHED
        self._runs.began(trial_id, config)
        return dict(config)

    def on_trial_result(self, trial_id: str, result: dict[str, Any]) -> None:
        if math.isfinite(result.get(BEST, math.nan)):
            self._best[trial_id] = result[BEST]

    def on_trial_complete(self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False) -> None:
        if result:
            self.on_trial_result(trial_id, result)
        best = self._best.pop(trial_id, None)
        config = self._runs.ended(trial_id)
        if config is not None and self._objectives:
            folder = self._experiment.trial_folder(self._identify(config))
            values = last_figures(read_rows(folder), self._objectives)
            if values is None:
                _log.warning("%s: the search learns nothing from it, as no evaluation gave all objectives", folder.name)
            self._search.tell_objectives(config["params"], values)
        elif config is not None:
            self._search.tell(config["params"], best)

    def save(self, checkpoint_path: str) -> None:
        """Does nothing: experiments are resumed from their trials' folders."""
