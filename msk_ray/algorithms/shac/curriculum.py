"""Contacts that start soft and harden during training, up to the trial's own physics."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from msk_ray.config import ContactCurriculum
from msk_ray.envs import Env
from msk_ray.errors import ConfigError


def between(start: Sequence[float], end: Sequence[float], progress: float) -> list[float]:
    """Interpolates from `start` (progress 0) to `end` (1): geometrically if both are positive, otherwise linearly.

    Time constants span decades, so linear steps would change little at first and nearly everything at the end.
    """
    mixed = []
    for a, b in zip(start, end, strict=True):
        if a > 0.0 and b > 0.0:
            mixed.append(math.exp((1.0 - progress) * math.log(a) + progress * math.log(b)))
        else:
            mixed.append((1.0 - progress) * a + progress * b)
    return mixed


class ContactSchedule:
    """Sets the contact parameters of an environment's pairs along the curriculum.

    Raises:
        ConfigError: the model's contacts are not explicit pairs.

    Attributes:
        progress: 0 at the curriculum's start, 1 where the trial's own physics is reached.
    """

    def __init__(self, config: ContactCurriculum, env: Env[Any]) -> None:
        self.config = config
        self.progress = 0.0
        self._env = env
        model = env.model
        if not model.npair:
            raise ConfigError(f"curriculum: env {env.config.name} has no contact pairs to soften; leave it out")
        self._ends = {
            "solref": np.array(model.pair_solref),
            "solreffriction": np.array(model.pair_solreffriction),
        }
        self._apply()

    def advance(self) -> None:
        """Take one step, after an epoch."""
        self.set_progress(self.progress + 1.0 / self.config.epochs)

    def set_progress(self, progress: float) -> None:
        """Go to a point of the curriculum."""
        # Sums of 1/epochs may fall short of 1 by rounding.
        self.progress = 1.0 if progress > 1.0 - 1e-9 else progress
        self._apply()

    def _apply(self) -> None:
        start = self.config.start.model_dump(exclude_none=True)
        fields = {}
        for name, end in self._ends.items():
            if name not in start or self.progress == 1.0:
                fields[name] = end
                continue
            rows = []
            for row, solref in zip(end, self._ends["solref"], strict=True):
                # In MuJoCo, solreffriction 0 means "use solref".
                target = solref if name == "solreffriction" and not row.any() else row
                rows.append(between(list(start[name]), list(target), self.progress))
            fields[name] = np.array(rows)
        self._env.sim.batch.set_contact_pairs(fields)
