"""The processes that train one trial together: each steps its share of the worlds, all hold the same networks.

They draw the same numbers for all worlds and keep their own part of them, average gradients, and gather what is learned
from. So a trial is the same, to rounding, however many processes it has, and so are its checkpoints.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

T = TypeVar("T")
_ALL_GATHER = getattr(dist, "all_gather_single", dist.all_gather_into_tensor)
"""Its name before torch 2.13 is deprecated since."""
_FOR_EVER = timedelta(days=365)
"""A process may wait for another that evaluates or compiles; whoever started them notices those that die or hang."""


class Group:
    """One process with all worlds.

    Attributes:
        rank: number of this process, from 0; process 0 writes logs and checkpoints.
        size: number of processes N.
    """

    rank = 0
    size = 1

    def mean(self, tensors: Sequence[Tensor]) -> None:
        """Replace each of these floating-point tensors by its mean over all processes."""

    def gather(self, part: Tensor, dim: int = 0) -> Tensor:
        """The values of all worlds, from those of the W worlds of each process, along axis `dim`."""
        return part

    def own(self, whole: Tensor, dim: int = 0) -> Tensor:
        """The values of this process's W worlds, from those of all N·W, along axis `dim`."""
        return whole

    def collect(self, value: T) -> list[T]:
        """A value of every process, ordered by rank; small, because it is sent through the host's memory."""
        return [value]

    def any(self, flag: bool) -> bool:
        """Whether a flag is set in any process."""
        return any(self.collect(flag))

    def tell(self, *order: Any) -> None:
        """In process 0: send an order to the others, which wait for one in `told`; without arguments, that it was the
        last."""

    def told(self) -> tuple[Any, ...]:
        """In the others: the next order; empty after the last."""
        return ()


ALONE = Group()


class PeerLost(RuntimeError):
    """A collective operation failed, as when another process has died."""


class ProcessGroup(Group):
    """One of several processes on one host: gloo between CPUs, NCCL between GPUs, one GPU each.

    A recorded CUDA graph may contain `mean` and `gather`. All processes then have to record and replay it together, and
    no two streams may run them at the same time.

    Args:
        rank, size: as in `Group`.
        device: this process's, "cpu" or "cuda:N"; its default (`use_device`).
        meeting: file that the processes find each other through; it must not exist yet.
    """

    def __init__(self, rank: int, size: int, device: str, meeting: Path) -> None:
        self.rank = rank
        self.size = size
        with _named():
            store = dist.FileStore(str(meeting), size)
            dist.init_process_group("gloo", store=store, rank=rank, world_size=size, timeout=_FOR_EVER)
            self._tensors: Any = None  # the group of all processes
            if device.startswith("cuda"):
                self._tensors = dist.new_group(backend="nccl", timeout=_FOR_EVER)

    @torch.no_grad()
    def mean(self, tensors: Sequence[Tensor]) -> None:
        flat = torch.cat([t.flatten() for t in tensors])
        with _named():
            dist.all_reduce(flat, group=self._tensors)
        flat /= self.size
        for tensor, part in zip(tensors, flat.split([t.numel() for t in tensors]), strict=True):
            tensor.copy_(part.view_as(tensor))

    @torch.no_grad()
    def gather(self, part: Tensor, dim: int = 0) -> Tensor:
        rows, *rest = part.shape
        whole = part.new_empty((self.size * rows, *rest))
        if part.numel():
            with _named():
                _ALL_GATHER(whole, part.contiguous(), group=self._tensors)
        return whole if dim == 0 else torch.cat(whole.chunk(self.size), dim)

    def own(self, whole: Tensor, dim: int = 0) -> Tensor:
        return whole.chunk(self.size, dim)[self.rank]

    def collect(self, value: T) -> list[T]:
        found: list[Any] = [None] * self.size
        with _named():
            dist.all_gather_object(found, value)
        return found

    def tell(self, *order: Any) -> None:
        with _named():
            dist.broadcast_object_list([order], src=0)

    def told(self) -> tuple[Any, ...]:
        order: list[Any] = [None]
        with _named():
            dist.broadcast_object_list(order, src=0)
        found: tuple[Any, ...] = order[0]
        return found


@contextmanager
def _named() -> Iterator[None]:
    """Give the errors of a collective operation, which are of many types, their name."""
    try:
        yield
    except RuntimeError as error:
        raise PeerLost(f"a collective operation failed: {(str(error).splitlines() or [''])[0]}") from error
