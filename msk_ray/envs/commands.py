"""Commands, computed from numbers drawn when an episode begins and from its age: a step draws nothing.

Axes: N episodes, W worlds, C numbers of a command.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple, Self

import torch
from torch import Tensor

from msk_ray.config.commands import Commands


class Draws(NamedTuple):
    """Where the random numbers of one command are, and when the command changes."""

    columns: slice
    """Columns of its numbers among the numbers of all commands."""
    times: int
    """Largest number of times that it is drawn in an episode."""
    every: tuple[float, float] | None
    """Shortest and longest time from one draw to the next [s]."""

    def value(self, drawn: Tensor, time: Tensor, ranges: Tensor) -> Tensor:
        """The command (W, C).

        Args:
            drawn: numbers of all commands, uniform in [0, 1), one row for each world.
            time: time since the episode began [s], (W,).
            ranges: smallest and largest values, (2, C).
        """
        draws = drawn[:, self.columns].unflatten(-1, (self.times, -1))
        if self.every is None:
            share = draws[:, 0]
        else:
            share = draws.take_along_dim(self.times_drawn(drawn, time)[:, None, None], 1)[:, 0, :-1]
        return torch.lerp(ranges[0], ranges[1], share)

    def times_drawn(self, drawn: Tensor, time: Tensor) -> Tensor:
        """How often the command has been drawn again since the episode began, (W,); arguments as for `value`."""
        assert self.every is not None
        shortest, longest = self.every
        until_next = drawn[:, self.columns].unflatten(-1, (self.times, -1))[:, :-1, -1]
        ends = (shortest + (longest - shortest) * until_next).cumsum(-1)
        return (time[:, None] >= ends).sum(-1)


class DrawnCommands(NamedTuple):
    """All commands of an environment."""

    draws: Mapping[str, Draws]
    size: int
    """Count of the random numbers of an episode, for all commands together."""
    ranges: Mapping[str, Tensor]
    """Smallest and largest values of each command, (2, C); they may be changed in place."""

    @classmethod
    def of(cls, commands: Commands, seconds: float, device: torch.device) -> Self:
        """The commands of a section, for episodes of at most `seconds` [s]."""
        draws, ranges, size = {}, {}, 0
        for command in commands.declared:
            section = getattr(commands, command.name)
            every = section.every if command.every is not None else None
            times = 1 if every is None else math.ceil(seconds / every[0])
            first, size = size, size + times * (len(command.ranges) + (every is not None))
            draws[command.name] = Draws(slice(first, size), times, every)
            spans = [getattr(section, part) for part in command.ranges]
            ranges[command.name] = torch.tensor(spans, device=device).T.contiguous()
        return cls(draws, size, ranges)

    def value(self, name: str, drawn: Tensor, time: Tensor) -> Tensor:
        """The command of this name, (W, C); `drawn` and `time` as for `Draws.value`."""
        return self.draws[name].value(drawn, time, self.ranges[name])
