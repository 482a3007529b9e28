"""The progress of trials as gauges on Ray's metrics port, for Prometheus and the dashboard in `cluster/grafana/`."""

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from ray.tune import Callback
from ray.util.metrics import Gauge

from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.outcomes import read_ending
from msk_ray.experiment.trial import Trial
from msk_ray.metrics import BEST_SCORE, EPISODE_RETURN, SCORE, STEPS_PER_SECOND
from msk_ray.text import printable

FIGURES = {
    "msk_ray_score": SCORE,
    "msk_ray_best_score": BEST_SCORE,
    "msk_ray_epoch": "epoch",
    "msk_ray_env_steps_per_s": STEPS_PER_SECOND,
    "msk_ray_episode_return": EPISODE_RETURN,
}
"""Gauge → metric. Ray adds `ray_` to a gauge's name."""
STATE = "msk_ray_trial_state"
"""1 for a trial's current state (`waiting`, `running` or its outcome); earlier states are set to 0 and dropped."""


REPEAT_S = 5.0
"""Interval at which values are set again [s]."""


class LastingGauges:
    """Gauge values that last until they are dropped.

    Ray stops serving a value that is not set again within 20 s, so a lasting state, or a score between evaluations,
    would disappear. A thread therefore sets every value again periodically.
    """

    def __init__(self) -> None:
        self._values: dict[tuple[int, tuple[tuple[str, str], ...]], Callable[[], None]] = {}
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._repeat, name="gauges", daemon=True)
        self._thread.start()

    def set(self, gauge: Gauge, value: float, tags: Mapping[str, str] | None = None) -> None:
        """Show a value from now on."""
        given = dict(tags or {})
        with self._lock:
            self._values[_key(gauge, given)] = lambda: gauge.set(value, given)
            gauge.set(value, given)

    def drop(self, gauge: Gauge, tags: Mapping[str, str]) -> None:
        """Set a value to 0, and stop showing it."""
        given = dict(tags)
        with self._lock:
            del self._values[_key(gauge, given)]
            gauge.set(0, given)

    def close(self) -> None:
        """Drop all values."""
        self._closed.set()
        self._thread.join()

    def _repeat(self) -> None:
        while not self._closed.wait(REPEAT_S):
            with self._lock:
                for set_again in self._values.values():
                    set_again()


def _key(gauge: Gauge, tags: Mapping[str, str]) -> tuple[int, tuple[tuple[str, str], ...]]:
    return id(gauge), tuple(sorted(tags.items()))


class TrialGauges:
    """A trial's newest values, set by its own process."""

    def __init__(self, experiment: str, trial: Trial) -> None:
        tags = _tags(experiment, trial)
        self._values = LastingGauges()
        self._gauges = {}
        for name, metric in FIGURES.items():
            gauge = Gauge(name, description=metric, tag_keys=tuple(tags))
            gauge.set_default_tags(tags)
            self._gauges[metric] = gauge

    def show(self, row: Mapping[str, float]) -> None:
        """Set the values of a row of metrics."""
        for metric, gauge in self._gauges.items():
            if metric in row:
                self._values.set(gauge, row[metric])

    def close(self) -> None:
        """Drop all values."""
        self._values.close()


class StateGauge(Callback):
    """Each trial's state, set by the driver, because a dead process cannot report its death."""

    def __init__(
        self, experiment: Experiment, waiting: Iterable[Trial], trial_of: Callable[[dict[str, Any]], Trial]
    ) -> None:
        """
        Args:
            experiment: to read endings from; they must be written before this callback is called.
            waiting: trials still to run.
            trial_of: the trial that a Tune config stands for.
        """
        self._experiment = experiment
        self._trial_of = trial_of
        self._states: dict[str, str] = {}
        self._values = LastingGauges()
        self._gauge = Gauge(
            STATE,
            description="1 at a trial's present state",
            tag_keys=("experiment", "trial", "variant", "seed", "state"),
        )
        for trial in waiting:
            self._set(trial, "waiting")

    def __getstate__(self) -> dict[str, Any]:
        # Ray pickles callbacks into its own state, which is never read back.
        return {}

    def close(self) -> None:
        """Drop all values."""
        self._values.close()

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        self._set(self._trial_of(trial.config), "running")

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        self._set(self._trial_of(trial.config), "waiting")

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        mine = self._trial_of(trial.config)
        ending = read_ending(self._experiment.trial_folder(mine.id))
        self._set(mine, "waiting" if ending is None else str(ending.outcome))

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        self.on_trial_complete(iteration, trials, trial)

    def _set(self, trial: Trial, state: str) -> None:
        tags = _tags(self._experiment.name, trial)
        before = self._states.get(trial.id)
        if before is not None:
            self._values.drop(self._gauge, tags | {"state": before})
        self._values.set(self._gauge, 1, tags | {"state": state})
        self._states[trial.id] = state


def _tags(experiment: str, trial: Trial) -> dict[str, str]:
    # Ray only allows ASCII in tags.
    variant = printable(trial.variant).replace("→", "->").encode("ascii", "backslashreplace").decode()
    return {"experiment": experiment, "trial": trial.id, "variant": variant, "seed": str(trial.seed)}
