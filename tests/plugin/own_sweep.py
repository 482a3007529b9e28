"""Parts of a sweep of one's own: a stop rule, a rule that compares trials, a search, and an operator."""

import random
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from msk_ray.experiment.outcomes import Ending, Outcome
from msk_ray.sweep.operators import Level, Operator
from msk_ray.sweep.rules.scheduler import NeverPrune, SchedulerSpec
from msk_ray.sweep.rules.stop_rule import History, StopRule
from msk_ray.sweep.search import Search


class Enough(StopRule):
    """Ends a trial after a number of evaluations."""

    evaluations: int

    def why(self, history: History) -> str | None:
        done = len(history.evaluations)
        return f"{done} evaluations are enough" if done >= self.evaluations else None


class Floor(SchedulerSpec):
    """Stops every trial that scores below a floor once it has used half of the budget."""

    floor: float

    def pruner(self, budget: float) -> "_Floor":
        return _Floor(self.floor, budget / 2)


class _Floor(NeverPrune):
    def __init__(self, floor: float, time: float) -> None:
        self.floor, self.time = floor, time

    def report(self, trial: str, time: float, score: float) -> Ending | None:
        low = time >= self.time and score < self.floor
        return Ending(Outcome.STOPPED_RULE, f"{score:g} is below {self.floor:g}") if low else None


class LowToHigh(Search):
    """Tries values from the lower to the upper ends of their ranges, and keeps what came of them."""

    told: list[tuple[dict[str, Any], float | None]]

    def __init__(self, parameters: Mapping[str, Operator], seed: int) -> None:
        super().__init__(parameters, seed)
        self.told, self._asked = [], 0

    def ask(self) -> dict[str, Any]:
        self._asked += 1
        ends = {key: [level.value for level in op.extremes()] for key, op in self.parameters.items()}
        return {key: low + (high - low) * self._asked / 10 for key, (low, high) in ends.items()}

    def tell(self, params: Mapping[str, Any], score: float | None) -> None:
        self.told.append((dict(params), score))


@dataclass(frozen=True)
class PowersOfTwo(Operator):
    """2ⁿ, n from the first number to the second one."""

    low: int
    high: int

    @classmethod
    def parse(cls, where: str, values: list[Any]) -> Self:
        return cls(*values)

    def draw(self, rng: random.Random) -> Level:
        value = 2 ** rng.randint(self.low, self.high)
        return Level(value, str(value))

    def extremes(self) -> tuple[Level, ...]:
        return Level(2**self.low, str(2**self.low)), Level(2**self.high, str(2**self.high))
