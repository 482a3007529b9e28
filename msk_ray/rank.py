"""`python -m msk_ray.rank`: one of a trial's several processes, started by `training.parallel`.

It is killed when its parent ends, however that happens. This is set up before the slow imports.
"""

import ctypes
import os
import signal
import sys
from multiprocessing.connection import Connection

_PR_SET_PDEATHSIG = 1


def end_with_parent(parent: int) -> None:
    """Let the kernel kill this process when the thread of process `parent` that started it ends."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if os.getppid() != parent:
        os._exit(1)  # the parent had already ended


def main() -> None:
    """Entry point: the file descriptor of a pipe to the parent, and the parent's process id."""
    descriptor, parent = map(int, sys.argv[1:])
    end_with_parent(parent)
    from msk_ray.training.parallel import serve

    serve(Connection(descriptor))
    # Skip the interpreter's shutdown, in which NCCL would wait for graphs that still refer to it.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
