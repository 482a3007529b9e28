"""Values that change linearly over training, for epochs counted from 0."""

from typing import Self

from pydantic import model_validator

from msk_ray.config.sections import Count, Fraction, Section, Whole


def ramp(start: float, end: float, epoch: float, last: int, first: int = 0) -> float:
    """A value that is `start` until the epoch `first`, `end` from the epoch `last` on, and linear in between."""
    return start + (end - start) * min(1.0, max(0.0, (epoch - first) / (last - first)))


class CommandSchedule(Section):
    """Factor on the ranges of commands in training: a humanoid that is asked to run from the start learns to stand.

    It is `start` until the epoch `begin`, 1 from the epoch `end` on, and linear in between.
    """

    start: Fraction
    begin: Whole
    end: Count

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.begin >= self.end:
            raise ValueError(f"end has to be greater than begin, {self.begin}")
        return self

    def at(self, epoch: int) -> float:
        """The factor at `epoch`, counted from 0."""
        return ramp(self.start, 1.0, epoch, self.end, self.begin)
