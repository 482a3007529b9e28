"""A fixed sequence of Warp launches, recorded once and replayed."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import warp as wp

from msk_ray.step.forward.compilation import compile_kernels
from msk_ray.step.garbage import without_collecting

_outer: list[wp.Stream] = []
"""The stream of another library's ongoing capture, if any."""


@contextmanager
def joining_capture(stream: wp.Stream) -> Iterator[list[Any]]:
    """Context inside another library's capture on `stream`: replays of graphs become part of that capture.

    Args:
        stream: the capturing stream, on which all replays must be requested.

    Yields:
        Objects to keep alive as long as the captured graph.
    """
    kept: list[Any] = []
    wp.capture_begin(stream=stream, external=True)
    _outer.append(stream)
    try:
        yield kept
    except BaseException:
        _outer.pop()
        with suppress(RuntimeError):  # the capture is already invalid; the first error is raised
            wp.capture_end(stream=stream)
        raise
    else:
        _outer.pop()
        kept.append(wp.capture_end(stream=stream))


def joined_stream() -> wp.Stream | None:
    """The stream of another library's capture that launches currently join; None if there is none. Such a capture
    cannot hold conditional nodes.

    Create no other wp.Stream of the same CUDA stream: when it is freed, Warp forgets the capture.
    """
    return _outer[-1] if _outer else None


class Graph:
    """Records the Warp work that `launches` issues, and replays it without Python in between.

    On CUDA this is a CUDA graph, on CPU Warp's own recorded operation stream. Launching one MuJoCo Warp step from
    Python takes about 2 ms on CPU (0.2 ms replayed) and 4 ms on GPU (0.3 ms replayed), so nothing here runs eagerly
    after start-up.

    `launches` must issue the same kernels on the same arrays every time, and must not read results back. Construction
    compiles the kernels, which leaves array contents undefined. The first run is eager: on CUDA at construction, so
    that a lack of memory shows up early; on CPU at the first replay, and the second one records, because recording
    costs more than running once.
    """

    def __init__(self, launches: Callable[[], None], device: wp.Device) -> None:
        self._device = device
        self._launches = launches
        self._graph: wp.Graph | None = None
        self._has_run = False
        compile_kernels(device, launches)
        if device.is_cuda:
            self._run()
            self._record()

    def replay(self, stream: wp.Stream | None = None) -> None:
        """Run the launches, on `stream` if the device is CUDA; within another capture, issue them into it."""
        if joined_stream() is not None:
            # Launch directly: a graph launched into a capture becomes a child graph, which cannot hold conditional
            # nodes either.
            with wp.ScopedDevice(self._device), wp.ScopedStream(stream, sync_enter=False):
                self._launches()
            return
        if not self._has_run:
            self._run()
            return
        if self._graph is None:
            self._record()
        wp.capture_launch(self._graph, stream=stream if self._device.is_cuda else None)

    def _run(self) -> None:
        with wp.ScopedDevice(self._device), without_collecting():
            self._launches()
            wp.synchronize_device(self._device)
        self._has_run = True

    def _record(self) -> None:
        with wp.ScopedDevice(self._device), without_collecting(), wp.ScopedCapture(device=self._device) as capture:
            self._launches()
        self._graph = capture.graph
