"""Processes that die at a chosen point."""

import os
import signal
import sys
from collections.abc import Callable
from typing import Any


def calls_of(work: Callable[[], object]) -> int:
    """How many C functions `work` calls in a forked process."""
    low, high = 0, 1
    while die_within(work, high):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if die_within(work, middle) else (low, middle)
    return low


def die_within(work: Callable[[], object], calls: int) -> bool:
    """Run `work` in a forked process that kills itself (SIGKILL) right before its `calls`-th call of a C function, such
    as those that open, write, flush and rename files.

    Returns:
        Whether it was killed; False if `work` was done before.

    Raises:
        RuntimeError: `work` itself failed.
    """
    child = os.fork()
    if child == 0:
        left = calls

        def count(frame: Any, event: str, argument: Any) -> None:
            nonlocal left
            if event == "c_call":
                left -= 1
                if left <= 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        code = 1
        try:
            sys.setprofile(count)
            work()
            sys.setprofile(None)
            code = 0
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL:
        return True
    if status:
        raise RuntimeError(f"the forked process failed: {status}")
    return False
