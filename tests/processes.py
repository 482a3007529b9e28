"""Programs under test as processes: each in a session of its own, of which nothing is left when the test ends."""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fault_campaign.processes import catches as catches
from fault_campaign.processes import stat_of


def members_of(session: int) -> dict[int, str]:
    """The living processes of a session, and their names."""
    processes = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and (stat := stat_of(int(entry.name))) and stat[4] == str(session):
            processes[int(entry.name)] = stat[0]
    return processes


class Launcher:
    """Starts programs; `end` kills what is left of them."""

    def __init__(self) -> None:
        self._sessions: list[int] = []

    def start(self, command: Sequence[str], **options: Any) -> "subprocess.Popen[str]":
        process = subprocess.Popen(command, start_new_session=True, text=True, **options)
        self._sessions.append(process.pid)
        return process

    def adopt(self, session: int) -> None:
        """Answer for a session that was started elsewhere."""
        self._sessions.append(session)

    def end(self) -> None:
        for session in self._sessions:
            for pid in members_of(session):
                with contextlib.suppress(ProcessLookupError):  # gone since it was counted
                    os.kill(pid, signal.SIGKILL)


def wait_until(condition: Callable[[], Any], process: "subprocess.Popen[str] | None" = None) -> None:
    """Wait for a condition, however slow the machine: what never comes true is the test's own time limit's to end."""
    while not condition():
        assert process is None or process.poll() is None, f"it ended before, with {process.returncode}"
        time.sleep(0.02)
