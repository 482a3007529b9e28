"""Compiles the kernels of work that is about to be launched, side by side.

Warp compiles a kernel when it is first launched, so that a new model takes the sum of all kernels' times. The compilers
are native code, which threads of one process run on all cores.
"""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from math import prod
from typing import Any

import warp as wp

_MOST_THREADS = 16
"""A compiler at work takes a few hundred megabytes."""

_Variant = tuple[wp.Module, int]
"""A module of kernels, and the number of threads per block for which it is compiled."""

_ready: set[tuple[str, wp.Module, int]] = set()
"""What this process has compiled or loaded: device, module, threads per block."""
_listener: Callable[[int, int], None] | None = None
_done = 0
"""Number of modules compiled or loaded so far, on all devices."""


def on_compiling(listener: Callable[[int, int], None] | None) -> None:
    """Call `listener` with the number of kernels that are ready, and how many are known to be needed: before some are
    compiled, and whenever one more is ready. None calls nothing any more.

    Kernels of one module count as one, because they are compiled together.
    """
    global _listener
    _listener = listener


def compile_kernels(device: wp.Device, *works: Callable[[], None]) -> None:
    """Compile, or load from Warp's cache, every kernel that `works` launch on `device`.

    This goes through the works without launching kernels or copying arrays. They may still clear arrays, whose contents
    are undefined afterwards.

    Raises:
        Exception: a kernel does not compile; whatever Warp raises when it is launched.
    """
    global _done
    wanted = [v for v in _variants(device, works) if (device.alias, *v) not in _ready]
    # The longest decides when all are ready.
    wanted.sort(key=_length, reverse=True)
    if not wanted:
        return
    total = _done + len(wanted)
    _report(total)
    threads = min(len(wanted), len(os.sched_getaffinity(0)), _MOST_THREADS)
    with ThreadPoolExecutor(threads, thread_name_prefix="compile") as pool:
        futures = {pool.submit(_load, device, variant): variant for variant in wanted}
        try:
            for future in as_completed(futures):
                future.result()
                _ready.add((device.alias, *futures[future]))
                _done += 1
                _report(total)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _report(total: int) -> None:
    if _listener is not None:
        _listener(_done, total)


def _length(variant: _Variant) -> int:
    """Length of the source of a module's kernels, without the functions that they call."""
    module, _ = variant
    return sum(len(kernel.adj.source) for kernel in module.kernels.values())


def _load(device: wp.Device, variant: _Variant) -> None:
    module, block_dim = variant
    wp.force_load(device, [module], block_dim)


def _variants(device: wp.Device, works: Sequence[Callable[[], None]]) -> list[_Variant]:
    """Each module of which the works launch a kernel, once, in the order of their launches."""
    seen: dict[_Variant, None] = {}

    def see(kernel: wp.Kernel, dim: int | Sequence[int], *_: Any, block_dim: int | None = None, **__: Any) -> None:
        # An instance of a generic kernel is known when it is launched, and then changes its module.
        generic = any(k.is_generic for k in kernel.module.kernels.values())
        if not generic and prod(dim if isinstance(dim, Sequence) else (dim,)) > 0:
            seen[kernel.module, block_dim or (1 if device.is_cpu else 256)] = None

    with wp.ScopedDevice(device), _instead_of_launching(see):
        for work in works:
            work()
    return list(seen)


@contextmanager
def _instead_of_launching(see: Callable[..., None]) -> Iterator[None]:
    """Context in which this thread's launches only call `see`, loops and branches run once, and nothing is copied."""
    thread = threading.get_ident()

    def once(condition: wp.array, while_body: Callable[..., None], **kwargs: Any) -> None:
        while_body(**kwargs)

    def both(
        condition: wp.array,
        on_true: Callable[..., None] | None = None,
        on_false: Callable[..., None] | None = None,
        **kwargs: Any,
    ) -> None:
        for branch in (on_true, on_false):
            if branch is not None:
                branch(**kwargs)

    def nothing(*_: Any, **__: Any) -> None:
        pass

    walked: dict[str, Callable[..., Any]] = {
        "launch": see,
        "launch_tiled": see,
        "capture_while": once,
        "capture_if": both,
        "copy": nothing,
    }
    kept = {name: getattr(wp, name) for name in walked}

    def here(name: str) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            return (walked if threading.get_ident() == thread else kept)[name](*args, **kwargs)

        return call

    for name in walked:
        setattr(wp, name, here(name))
    try:
        yield
    finally:
        for name, function in kept.items():
            setattr(wp, name, function)
