"""Streams of numbers for code that draws from torch's global generators."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch


class GlobalStreams:
    """Named streams, each with a seed of its own, that take the place of torch's global generators for a while.

    Args:
        seeds: seed of each stream.
        device: the device whose generator is replaced, besides the CPU's.
    """

    def __init__(self, seeds: Mapping[str, int], device: torch.device) -> None:
        self._device = device
        self._states = {}
        before = self._now()
        for name, seed in seeds.items():
            torch.manual_seed(seed)
            self._states[name] = self._now()
        self._set(before)

    @contextmanager
    def drawing(self, name: str) -> Iterator[None]:
        """Within, the global generators go on with the stream."""
        before = self._now()
        self._set(self._states[name])
        try:
            yield
        finally:
            self._states[name] = self._now()
            self._set(before)

    def state_dict(self) -> dict[str, Any]:
        """Where the streams are."""
        return {name: list(states) for name, states in self._states.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._states = {name: tuple(part.cpu() for part in states) for name, states in state.items()}

    def _now(self) -> tuple[torch.Tensor, ...]:
        cuda = (torch.cuda.get_rng_state(self._device),) if self._device.type == "cuda" else ()
        return (torch.get_rng_state(), *cuda)

    def _set(self, states: tuple[torch.Tensor, ...]) -> None:
        torch.set_rng_state(states[0])
        if len(states) > 1:
            torch.cuda.set_rng_state(states[1], self._device)
