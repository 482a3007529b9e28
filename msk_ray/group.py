"""The processes that train one trial together: each steps its share of the worlds, and all hold the same networks.

Each draws the random numbers of all worlds and uses its own part. They average gradients, and gather observations,
rewards and targets. So results and checkpoints do not depend on the number of processes, except for rounding.
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
"""A function of torch that 2.13 has renamed; the old name is deprecated."""
_FOR_EVER = timedelta(days=365)
"""Timeout of collectives: long, because a process may wait for another that evaluates or compiles. The parent notices
processes that die or hang."""


class Group:
    """One process with all worlds.

    Attributes:
        rank: number of this process, from 0; process 0 writes logs and checkpoints.
        size: number of processes N.
    """

    rank = 0
    size = 1

    def mean(self, tensors: Sequence[Tensor]) -> None:
        """Replace each of these floating-point tensors, in place, by its mean over all processes."""

    def gather(self, part: Tensor, dim: int = 0) -> Tensor:
        """Values of all N·W worlds along axis `dim`, from the values of each process's W worlds."""
        return part

    def own(self, whole: Tensor, dim: int = 0) -> Tensor:
        """Values of this process's W worlds along axis `dim`, from the values of all N·W worlds."""
        return whole

    def collect(self, value: T) -> list[T]:
        """The values of all processes, by rank. For small values, because they are pickled through the host."""
        return [value]

    def any(self, flag: bool) -> bool:
        """Whether a flag is set in any process."""
        return any(self.collect(flag))

    def send_order(self, *order: Any) -> None:
        """In process 0: send an order to the others, which wait in `receive_order`. Without arguments: the end."""

    def receive_order(self) -> tuple[Any, ...]:
        """In the others: the next order; empty at the end."""
        return ()


ALONE = Group()


class PeerLost(RuntimeError):
    """A collective operation failed, for example because another process has died."""


class ProcessGroup(Group):
    """One of several processes on one host: gloo between CPUs, NCCL between GPUs, one GPU each.

    Recorded CUDA graphs may contain `mean` and `gather`. Then all processes must record and replay together, and two
    streams must not run them at the same time.

    Args:
        rank, size: as in `Group`.
        device: this process's device, "cpu" or "cuda:N", already its default (`use_device`).
        meeting: file by which the processes find each other; it must not exist yet.
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
        values: list[Any] = [None] * self.size
        with _named():
            dist.all_gather_object(values, value)
        return values

    def send_order(self, *order: Any) -> None:
        with _named():
            dist.broadcast_object_list([order], src=0)

    def receive_order(self) -> tuple[Any, ...]:
        order: list[Any] = [None]
        with _named():
            dist.broadcast_object_list(order, src=0)
        message: tuple[Any, ...] = order[0]
        return message


@contextmanager
def _named() -> Iterator[None]:
    """Context that turns the errors of a collective operation into `PeerLost`."""
    try:
        yield
    except RuntimeError as error:
        raise PeerLost(f"a collective operation failed: {(str(error).splitlines() or [''])[0]}") from error
