"""What the worlds of an environment remember from one env step to the next.

Axes: W worlds.
"""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from msk_ray.envs.records import EnvState
from msk_ray.errors import CheckpointError


class Memory(NamedTuple):
    """Declaration of one tensor of memory, (W, size)."""

    size: int
    """Numbers for each world."""
    gradient: bool = False
    """Whether gradients flow through it from env step to env step; otherwise they stay within a step."""
    start: float = 0.0
    """Value at the start of an episode, unless `Env.begin_memory` gives another one."""


class Memories:
    """The declared memories of all worlds.

    Args:
        declared: their declarations by name.
        nworld: number of worlds W.
        device: where their values are.

    Attributes:
        start: declared values at the start of an episode, (W, size), by name.
    """

    def __init__(self, declared: Mapping[str, Memory], nworld: int, device: torch.device) -> None:
        self.start = {
            name: torch.full((nworld, memory.size), float(memory.start), device=device)
            for name, memory in declared.items()
        }
        self._with_gradient = {name for name, memory in declared.items() if memory.gradient}

    def __bool__(self) -> bool:
        return bool(self.start)

    def ordered(self, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Values (W, size) by name in the order of the declarations."""
        return {name: values[name] for name in self.start}

    def carried(self, state: EnvState) -> EnvState:
        """A state as the next step begins with it: memories without gradient are detached from the graph."""
        memory = {
            name: values if name in self._with_gradient else values.detach() for name, values in state.memory.items()
        }
        return state._replace(memory=memory)

    def begun(self, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Values at the start of episodes, (W, size) by name: the given ones, and the declared ones for the rest."""
        return {name: values[name].detach() if name in values else start for name, start in self.start.items()}


def restored(state: EnvState, saved: Mapping[str, Tensor]) -> EnvState:
    """A state with the saved values of its memories; memories that were not saved stay as they are.

    Raises:
        CheckpointError: a memory was saved with another size.
    """
    for name, values in state.memory.items():
        if name in saved and saved[name].shape != values.shape:
            raise CheckpointError(
                f"the checkpoint has a memory {name!r} of {saved[name].shape[1]} numbers, and its environment one of "
                f"{values.shape[1]}: begin another trial"
            )
    return state._replace(memory={name: saved.get(name, values) for name, values in state.memory.items()})
