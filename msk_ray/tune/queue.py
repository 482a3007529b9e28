"""Which trial Tune runs next: from a list or from a search."""

import logging
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ray.tune.search import BasicVariantGenerator, Searcher

from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import last_figures, progress_of, read_rows
from msk_ray.sweep.search import Search
from msk_ray.tune.schedulers import METRIC

_log = logging.getLogger(__name__)


class TrialList(BasicVariantGenerator):
    """Trials of a list, created by Tune's own generator from the parameter space."""

    def __init__(self, max_concurrent: int | None) -> None:
        # Tune does not limit concurrency for a given generator, so limit it here.
        super().__init__(max_concurrent=max_concurrent or 0)

    def save_to_dir(self, dirpath: str, session_str: str) -> None:
        """Does nothing: experiments are resumed from their trials' folders."""

    def has_checkpoint(self, dirpath: str) -> bool:
        return False


class Suggestions(Searcher):
    """Trials suggested by a search, which gets the best score of each ended trial, or its objectives."""

    def __init__(
        self,
        experiment: Experiment,
        identify: Callable[[Mapping[str, Any]], str],
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
        self._experiment, self._identify, self._objectives = experiment, identify, objectives
        self._search = search
        self._begun = deque(begun)
        self._left = samples
        self._running: dict[str, dict[str, Any]] = {}

    def suggest(self, trial_id: str) -> Any:
        """The Tune config of the next trial."""
        if self._left <= 0:
            return Searcher.FINISHED
        self._left -= 1
        params = dict(self._begun.popleft() if self._begun else self._search.ask())
        self._running[trial_id] = params
        return {"params": dict(params)}

    def on_trial_complete(self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False) -> None:
        params = self._running.pop(trial_id)
        folder = self._experiment.trial_folder(self._identify({"params": params}))
        rows = read_rows(folder)
        if not self._objectives:
            self._search.tell(params, progress_of(rows).best)
            return
        values = last_figures(rows, self._objectives)
        if values is None:
            _log.warning("%s: the search learns nothing from it, as no evaluation gave all objectives", folder.name)
        self._search.tell_objectives(params, values)

    def save(self, checkpoint_path: str) -> None:
        """Does nothing: experiments are resumed from their trials' folders."""
