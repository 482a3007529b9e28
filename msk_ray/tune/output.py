"""Redirects a trial process's output to a file of limited size."""

import os
import sys
import time
from pathlib import Path

LIMIT = 16 << 20
"""Size above which the middle of a trial's output is cut out [B]."""
KEPT_FIRST, KEPT_LAST = 1 << 20, 4 << 20
"""Size of its beginning and of its end that are kept [B]."""


def redirect_output(path: Path) -> None:
    """Append all output of this process, also from native code, to a file."""
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    sys.stdout.flush()
    sys.stderr.flush()
    os.dup2(file, 1)
    os.dup2(file, 2)
    os.close(file)


def limit_output(path: Path) -> None:
    """Cut the middle out of a file that has become larger than `LIMIT`, and say so there.

    Edits the file in place, because child processes may have it open too; output during the edit may be lost.
    """
    size = path.stat().st_size
    if size <= LIMIT:
        return
    with path.open("r+b") as file:
        first = file.read(KEPT_FIRST)
        file.seek(size - KEPT_LAST)
        last = file.read()
        when = time.strftime("%Y-%m-%d %H:%M:%S")
        note = f"\n--- {when}: more than {LIMIT >> 20} MiB were printed; what came here is left out\n".encode()
        file.seek(len(first))
        file.write(note + last)
        file.truncate()
