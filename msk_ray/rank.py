"""`python -m msk_ray.rank`: one process of a trial that has several; only `training.parallel` starts it.

It ends with its parent, however that ends. This comes before the imports that take seconds.
"""

import ctypes
import os
import signal
import sys
from multiprocessing.connection import Connection

_PR_SET_PDEATHSIG = 1


def end_with_parent(parent: int) -> None:
    """Have the kernel kill this process when the thread that started it ends, in the process `parent`."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if os.getppid() != parent:
        os._exit(1)  # it had ended before


def main() -> None:
    """Entry point: the file descriptor of a pipe to the parent, and the parent's process id."""
    descriptor, parent = map(int, sys.argv[1:])
    end_with_parent(parent)
    from msk_ray.training.parallel import serve

    serve(Connection(descriptor))
    # Not by the interpreter's end: NCCL waits there for graphs that still refer to it.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
