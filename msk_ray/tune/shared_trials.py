"""The trials of a sweep, stored once in Ray for all of its processes."""

from collections.abc import Iterable

import ray
from ray import cloudpickle

from msk_ray.experiment.trial import Trial


class SharedTrials:
    """Trials by id, as one object in Ray's store.

    Tune unpickles what it runs for every trial that it adds, and every process does so again. Only a reference to the
    trials is part of that; a node fetches them once, and a process unpickles the one it asks for.
    """

    def __init__(self, trials: Iterable[Trial]) -> None:
        self._unpickled = {trial.id: trial for trial in trials}
        self._stored = ray.put({name: cloudpickle.dumps(trial) for name, trial in self._unpickled.items()})

    def __getstate__(self) -> "ray.ObjectRef[dict[str, bytes]]":
        return self._stored

    def __setstate__(self, stored: "ray.ObjectRef[dict[str, bytes]]") -> None:
        self._unpickled, self._stored = {}, stored

    def __getitem__(self, trial_id: str) -> Trial:
        if trial_id not in self._unpickled:
            self._unpickled[trial_id] = cloudpickle.loads(ray.get(self._stored)[trial_id])
        return self._unpickled[trial_id]
