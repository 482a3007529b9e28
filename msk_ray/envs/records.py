"""What environments keep, give and draw: the state of all worlds, a transition, and the starts of episodes.

Axes: W worlds, N episodes, O observation, A action.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from msk_ray.step import StepState


class EnvState(NamedTuple):
    """The state of every world."""

    physics: StepState
    """Physical state, attached to the graph."""
    action: Tensor
    """Last action, shape (W, A), attached."""
    age: Tensor
    """Env steps since reset, shape (W,), int64."""
    numbers: Tensor
    """Numbers drawn for each world's episode, shape (W, K + T): K by `physics.randomize`, then T of the task: those of
    `Env.draw_start`, and the draws of commands."""
    memory: Mapping[str, Tensor] = MappingProxyType({})
    """What the worlds remember, each (W, size), by name; attached where that is declared."""

    def tensors(self) -> list[Tensor]:
        """All tensors in a fixed order."""
        return [*self.physics, self.action, self.age, self.numbers, *self.memory.values()]

    def mapped(self, change: Callable[[Tensor], Tensor]) -> "EnvState":
        """The state of changed tensors."""
        return EnvState(
            StepState(*map(change, self.physics)),
            change(self.action),
            change(self.age),
            change(self.numbers),
            {name: change(values) for name, values in self.memory.items()},
        )

    def detach(self) -> "EnvState":
        """The same state, cut from the graph."""
        return self._replace(
            physics=StepState(*(t.detach() for t in self.physics)),
            action=self.action.detach(),
            memory={name: values.detach() for name, values in self.memory.items()},
        )

    def replaced(self, worlds: Tensor, fresh: "EnvState") -> "EnvState":
        """The same state, but in the given worlds (W,) that of `fresh`."""
        return EnvState(
            StepState(*(rows_where(worlds, f, own) for f, own in zip(fresh.physics, self.physics, strict=True))),
            rows_where(worlds, fresh.action, self.action),
            torch.where(worlds, fresh.age, self.age),
            rows_where(worlds, fresh.numbers, self.numbers),
            {name: rows_where(worlds, fresh.memory[name], own) for name, own in self.memory.items()},
        )


class Resets(NamedTuple):
    """What the next episodes of worlds begin with; N episodes."""

    physics: StepState
    """Physical states, each (N, n)."""
    numbers: Tensor
    """As in `EnvState`, (N, K + T)."""


class Transition(NamedTuple):
    """One env step of all worlds."""

    reward: Tensor
    """Reward, shape (W,); 0 in a world that diverged."""
    terms: Tensor
    """Weighted parts of the reward, detached, which sum to it, shape (W, T), named by the environment's
    `reward_names`."""
    reached: EnvState
    """The state reached, before any reset, attached."""
    obs: Tensor
    """Observation of it, shape (W, O)."""
    terminated: Tensor
    """The episode ended by itself (fell, diverged): nothing follows, shape (W,) bool."""
    truncated: Tensor
    """The time limit cut the episode: the value of later steps still counts, shape (W,) bool."""
    diverged: Tensor
    """The physics exceeded all bounds, shape (W,) bool; included in `terminated`."""


def rows_where(worlds: Tensor, chosen: Tensor, others: Tensor) -> Tensor:
    """Rows (W, n) of `chosen` in the given worlds (W,), else of `others`."""
    return torch.where(worlds[:, None], chosen, others) if others.shape[1] else others
