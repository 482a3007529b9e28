"""Ends a sweep whose experiment folder has disappeared (moved, removed, no longer mounted) or has another owner."""

import shutil
import time
from collections.abc import Callable
from typing import Any

from ray.tune import Callback

from msk_ray.experiment.manifest import Experiment


def remove_remains(experiment: Experiment) -> None:
    """Remove the folders that Ray has written where an experiment has disappeared. Ray creates the folders it writes
    to, and an experiment that is moved back would end up inside them."""
    path = experiment.path
    if not path.is_dir() or experiment.lost() is None:
        return
    # A request to stop, written at the first sign of the loss, may be there too.
    if {child.name for child in path.iterdir()} <= {experiment.tune.name, experiment.stop_file.name}:
        shutil.rmtree(path)


class ExperimentWatch(Callback):
    """Checks periodically that the experiment's manifest exists, without which trials cannot save themselves.

    It also checks that this driver still owns the experiment.
    """

    INTERVAL_S = 2.0

    def __init__(self, experiment: Experiment, guard: Callable[[], None]) -> None:
        self._experiment = experiment
        self._guard = guard
        self._checked = time.monotonic()

    def __getstate__(self) -> dict[str, Any]:
        # Ray pickles callbacks into its own state, which is never read back.
        return {}

    def on_step_begin(self, iteration: int, trials: list[Any], **info: Any) -> None:
        self._guard()

    def on_step_end(self, iteration: int, trials: list[Any], **info: Any) -> None:
        if time.monotonic() - self._checked >= self.INTERVAL_S:
            self._checked = time.monotonic()
            self._experiment.check_there()
