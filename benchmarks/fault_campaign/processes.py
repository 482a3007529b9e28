"""Processes as /proc shows them."""

import signal
from pathlib import Path


def stat_of(pid: int) -> list[str]:
    """Name, then the fields of /proc/PID/stat from the state on; empty if there is no such process, or a dead one."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return []
    name, _, rest = text[text.index("(") + 1 :].rpartition(")")
    fields = rest.split()
    return [] if fields[0] == "Z" else [name, *fields]


def name_of(pid: int) -> str:
    """Of its program, cut to 15 characters; empty if there is no such process."""
    return next(iter(stat_of(pid)), "")


def command_of(pid: int) -> str:
    """The command line of a process, or what it calls itself; empty if there is no such process."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return ""


def birth_of(pid: int) -> str:
    """When a process was started: its number alone may be used again."""
    stat = stat_of(pid)
    return stat[20] if stat else ""


def descendants_of(pid: int) -> list[int]:
    """Its children, theirs, and so on."""
    parent = {
        p: int(s[2]) for p in (int(e.name) for e in Path("/proc").iterdir() if e.name.isdigit()) if (s := stat_of(p))
    }
    found, level = [], [pid]
    while level:
        level = [child for child, above in parent.items() if above in level]
        found += level
    return found


def catches(pid: int, number: signal.Signals) -> bool:
    """Whether a process has a handler of its own for a signal."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("SigCgt:"):
            return bool(int(line.split()[1], 16) >> (number - 1) & 1)
    return False
