"""What environments keep, give and draw: the state of all worlds, a transition, and the starts of episodes.

Axes: W worlds, N episodes, O observation, A action.
"""

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
    """Numbers drawn for each world's episode, shape (W, K + T): K by `physics.randomize`, then T of the task."""

    def detach(self) -> "EnvState":
        """The same state, cut from the graph."""
        return EnvState(StepState(*(t.detach() for t in self.physics)), self.action.detach(), self.age, self.numbers)

    def replaced(self, worlds: Tensor, fresh: "EnvState") -> "EnvState":
        """The same state, but in the given worlds (W,) that of `fresh`."""
        return EnvState(
            StepState(*(rows_where(worlds, f, own) for f, own in zip(fresh.physics, self.physics, strict=True))),
            rows_where(worlds, fresh.action, self.action),
            torch.where(worlds, fresh.age, self.age),
            rows_where(worlds, fresh.numbers, self.numbers),
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
    obs: Tensor
    """Observation of the state reached, before any reset, shape (W, O)."""
    terminated: Tensor
    """The episode ended by itself (fell, diverged): nothing follows, shape (W,) bool."""
    truncated: Tensor
    """The time limit cut the episode: the value of later steps still counts, shape (W,) bool."""
    diverged: Tensor
    """The physics exceeded all bounds, shape (W,) bool; included in `terminated`."""


def rows_where(worlds: Tensor, chosen: Tensor, others: Tensor) -> Tensor:
    """Rows (W, n) of `chosen` in the given worlds (W,), else of `others`."""
    return torch.where(worlds[:, None], chosen, others) if others.shape[1] else others
