"""Garbage collection, put off where it fails or finds nothing."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_collecting() -> Iterator[None]:
    """Context without garbage collection, which might free a CUDA graph: a capture in progress then fails."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextmanager
def lasting_imports() -> Iterator[None]:
    """Context of imports that stay for the life of the process, without garbage collection.

    Kernels are a million objects, through which Python would look again and again, for a quarter of the time that the
    imports take. Collections leave alone from then on what exists at the end.
    """
    enabled = gc.isenabled()
    with without_collecting():
        yield
        if enabled:
            gc.freeze()
