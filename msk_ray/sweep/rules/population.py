"""Population-based training: the worst trials continue from the best ones' states, with slightly changed settings."""

from collections.abc import Collection
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from msk_ray.errors import ConfigError
from msk_ray.sweep.rules.scheduler import SchedulerSpec, Share

if TYPE_CHECKING:
    from msk_ray.sweep.space import SpaceFile


class PopulationBasedTraining(SchedulerSpec):
    """Ends no trial; instead, trials take over the state and settings of better ones."""

    ends_trials = False
    exchanges = True

    interval: Share = 0.1
    """Time between exchanges, as a share of the budget."""
    quantile: Annotated[float, Field(gt=0.0, le=0.5)] = 0.25
    """Share of trials that continue from better ones at an exchange."""
    resample: Annotated[float, Field(ge=0.0, le=1.0)] = 0.25
    """Probability that an exchanged value is redrawn instead of changed by a fifth."""

    def check(self, file: "SpaceFile", ranges: Collection[str]) -> None:
        super().check(file, ranges)
        if not ranges:
            raise ConfigError("scheduler.kind: pbt needs a parameter with a range (uniform, loguniform)")
        if file.resources.halve_worlds_on_oom:
            raise ConfigError(
                "resources.halve_worlds_on_oom (--halve-worlds): pbt passes the states of all worlds from one trial to "
                "another, so all need the same number; write false"
            )
        if file.searches:
            raise ConfigError("scheduler.kind: pbt chooses values itself; write search: random")
