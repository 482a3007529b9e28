"""Out-of-memory errors of torch, Warp and NumPy, with the settings to lower."""

from collections.abc import Iterator
from contextlib import contextmanager

from msk_ray.errors import Failure, SimulationError
from msk_ray.step.autograd.out_of_memory import is_out_of_memory


@contextmanager
def named_out_of_memory(device: str, nworld: int, *lower: str) -> Iterator[None]:
    """Turn any library's failed allocation into a `SimulationError` that says to lower the settings `lower`.

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
