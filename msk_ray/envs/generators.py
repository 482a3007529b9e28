"""Generators of random numbers: those of an environment, and those that every library of a process shares, draws from
which do not repeat."""

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch


def seed_stream(generator: torch.Generator, seed: int, stream: int) -> None:
    """Seed a generator so that its numbers are others than those of other streams, and than those of `seed` itself."""
    generator.manual_seed(int(np.random.SeedSequence((seed, stream)).generate_state(1)[0]))


class GlobalGenerators:
    """Notices draws from the generators that belong to nobody.

    Looking at them waits for no device: the state of a CUDA generator is a seed and a count on the host.

    Args:
        device: the device whose generator counts, in addition to those of the CPU.
        python: whether Python's own counts, which other threads may draw from meanwhile.
    """

    def __init__(self, device: torch.device, *, python: bool = True) -> None:
        self._device = device
        self._python = python

    def state(self) -> Mapping[str, Any]:
        """The states of all, by name."""
        _, keys, place, *rest = np.random.get_state(legacy=True)
        states: dict[str, Any] = {
            "torch's global generator": torch.get_rng_state().numpy().tobytes(),
            "numpy's global generator": (np.asarray(keys).tobytes(), place, *rest),
        }
        if self._python:
            states["Python's global generator"] = random.getstate()
        if self._device.type == "cuda":
            states[f"torch's global generator of {self._device}"] = (
                torch.cuda.get_rng_state(self._device).numpy().tobytes()
            )
        return states

    def changed(self, before: Mapping[str, Any]) -> str | None:
        """The name of one that has drawn since it had the state of `before`; None if none has."""
        return next((name for name, state in self.state().items() if state != before[name]), None)
