"""Ends the processes of a Ray session and removes its folder. As a program, does so when the driver has ended.

The program imports only the standard library. Its arguments are the folder and the driver's process id; it notices the
driver's end, however it ends, because the driver holds the other end of its standard input.
"""

import os
import shutil
import signal
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path

KEEP = b"keep"
"""Message from the driver to keep the folder."""
_POLL_S = 0.02
_LIMIT_S = 20.0
"""Longest time to wait for the end of processes [s]; one may hang in the kernel."""


def end_processes(folder: Path, spared: Collection[int]) -> None:
    """Kill all processes of a session folder, and wait until they have ended: those with the folder in their
    environment, and those with a file in it open for writing.

    Args:
        folder: Ray's folder.
        spared: processes not to kill.
    """
    deadline = time.monotonic() + _LIMIT_S
    while time.monotonic() < deadline:
        pids = [pid for pid in _own_processes() if pid not in spared and _belongs(pid, folder)]
        if not pids:
            return
        for pid in pids:
            _kill(pid, folder)
        time.sleep(_POLL_S)


def _own_processes() -> Iterator[int]:
    for entry in Path("/proc").iterdir():
        with suppress(OSError):  # it has just ended
            if entry.name.isdigit() and entry.stat().st_uid == os.geteuid():
                yield int(entry.name)


def _belongs(pid: int, folder: Path) -> bool:
    """Whether a living process belongs to a folder.

    Some of Ray's processes write their name over their environment; their logs are open.
    """
    with suppress(OSError):  # it has just ended
        if f"RAY_TMPDIR={folder}".encode() in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0"):
            return True
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):  # it has just been closed
                if os.readlink(entry).startswith(f"{folder}/") and _writes(pid, entry.name):
                    return True
    return False


def _writes(pid: int, descriptor: str) -> bool:
    """Whether a process's descriptor is open for writing; mere readers of the logs do not count."""
    lines = Path(f"/proc/{pid}/fdinfo/{descriptor}").read_text().splitlines()
    facts = dict(line.split(":", 1) for line in lines if ":" in line)
    return int(facts["flags"], 8) & os.O_ACCMODE != os.O_RDONLY


def _kill(pid: int, folder: Path) -> None:
    """Kill a process of a folder, but not another process that has reused its number."""
    with suppress(ProcessLookupError):
        handle = os.pidfd_open(pid)
        try:
            if _belongs(pid, folder):
                signal.pidfd_send_signal(handle, signal.SIGKILL)
        finally:
            os.close(handle)


def main() -> None:
    """Wait until the driver ends or asks to clean up."""
    # Signals are meant for the driver; only its end ends this process.
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP, signal.SIGCHLD}:
        signal.signal(number, signal.SIG_IGN)
    folder, driver = Path(sys.argv[1]), int(sys.argv[2])
    word = sys.stdin.buffer.read()
    end_processes(folder, {driver, os.getpid()})
    if word != KEEP:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
