"""Records torch operations and simulation steps together as one CUDA graph."""

from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from msk_ray.step.autograd.buffers import stream_of
from msk_ray.step.forward import joining_capture
from msk_ray.step.garbage import without_collecting

T = TypeVar("T")


class Recording(Generic[T]):
    """Work recorded once as a CUDA graph. Recording it runs none of it.

    The work must have run eagerly before, so that kernels are compiled, lazy buffers exist and libraries have chosen
    their algorithms. It must do the same on the same memory every time: it reads inputs from existing tensors, and
    writes results to `result`, whose memory the next replay overwrites. It may differentiate, including through the
    step of a Simulation.

    Args:
        work: what to record.
        stream: stream to record on. Recordings that run at the same time need different streams, because libraries such
            as cuBLAS have one workspace per stream.
        pool: memory shared with recordings that are replayed one after the other in the order of their recording.

    Attributes:
        result: the return value of `work`; its tensors have contents after the first replay.

    Raises:
        RuntimeError: the work waits for the device, for example with `.item()`, or draws numbers from a generator.
    """

    def __init__(self, work: Callable[[], T], stream: torch.cuda.Stream, pool: Any = None) -> None:
        self._graph = torch.cuda.CUDAGraph()
        # Keep backward passes on this thread, because Warp's current stream is per thread. Collect no garbage until
        # torch's capture has ended: Warp's ends first, and then Warp frees arrays at once, which spoils torch's.
        with (
            without_collecting(),
            torch.cuda.device(stream.device),
            torch.autograd.set_multithreading_enabled(False),
            torch.cuda.graph(self._graph, pool=pool, stream=stream, capture_error_mode="thread_local"),
        ):
            own = stream_of(stream.device)
            assert own is not None, f"{stream.device} has no graphs"
            with joining_capture(own) as self._kept:
                self.result = work()

    def replay(self) -> T:
        """Run the work on torch's current stream, and return `result`."""
        self._graph.replay()
        return self.result

    @property
    def pool(self) -> Any:
        """Its memory, to share with another recording."""
        return self._graph.pool()


def fill(buffers: Sequence[Tensor], values: Sequence[Tensor]) -> None:
    """Copy values into the tensors that a recording reads."""
    with torch.no_grad():
        for buffer, value in zip(buffers, values, strict=True):
            if buffer is not value:
                buffer.copy_(value)
