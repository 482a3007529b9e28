"""Commands as functions of the numbers drawn when an episode begins, and of its age: a step draws nothing.

Axes: N episodes, W worlds, C numbers of a command.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from msk_ray.config.commands import Commands


class Draws(NamedTuple):
    """The draws of one command for an episode."""

    columns: slice
    """Their place among those of all commands."""
    times: int
    """How often it can be drawn in an episode."""
    every: tuple[float, float] | None
    """Shortest and longest time from one draw to the next [s]."""

    def value(self, drawn: Tensor, time: Tensor, ranges: Tensor) -> Tensor:
        """The command (W, C).

        Args:
            drawn: the draws of all commands, uniform in [0, 1), one row for each world.
            time: since the episode began [s], (W,).
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


def plan(commands: Commands, seconds: float) -> tuple[dict[str, Draws], int]:
    """The draws of each command for episodes of so many seconds, and how many numbers all take."""
    draws, first = {}, 0
    for command in commands.declared:
        section = getattr(commands, command.name)
        every = section.every if command.every is not None else None
        times = 1 if every is None else math.ceil(seconds / every[0])
        size = times * (len(command.ranges) + (every is not None))
        draws[command.name] = Draws(slice(first, first + size), times, every)
        first += size
    return draws, first


def ranges_of(commands: Commands, device: torch.device) -> dict[str, Tensor]:
    """Smallest and largest values of each command, (2, C), by name."""
    settings: Mapping[str, Mapping[str, tuple[float, float]]] = commands.model_dump()
    return {
        command.name: torch.tensor(
            [settings[command.name][part] for part in command.ranges], device=device
        ).T.contiguous()
        for command in commands.declared
    }
