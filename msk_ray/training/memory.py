"""Recognise out-of-memory errors of torch, Warp and NumPy."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from msk_ray.errors import Failure, SimulationError

# Warp and torch's CPU allocator raise plain RuntimeErrors, which can only be recognised by their wording.
_WORDING = ("failed to allocate", "can't allocate memory", "cudaerrormemoryallocation", "error 2: out of memory")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception says that memory could not be allocated."""
    if isinstance(error, (torch.OutOfMemoryError, MemoryError)):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error).lower() for words in _WORDING)


@contextmanager
def named_out_of_memory(device: str, nworld: int, *lower: str) -> Iterator[None]:
    """Turn any library's failed allocation into a `SimulationError` that names the settings `lower` as those to lower.

    Raises:
        SimulationError: with `Failure.OUT_OF_MEMORY`; any other exception passes unchanged.
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        what = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise SimulationError(
            f"out_of_memory: {device} has too little memory for {nworld} worlds; lower {' or '.join(lower)} ({what})",
            Failure.OUT_OF_MEMORY,
        ) from error
