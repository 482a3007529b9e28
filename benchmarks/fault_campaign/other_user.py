"""Another user of the machine tries to read and to replace what a sweep's Ray keeps on it."""

import json
import os
import random
import socket
from collections.abc import Callable
from pathlib import Path

from fault_campaign.reference import Reference
from fault_campaign.space import EPOCHS
from fault_campaign.sweep import Sweep
from fault_campaign.tally import Tally, judge

OTHER = 65534
"""The other user (nobody)."""


def as_another_user(work: Callable[[], list[str]]) -> list[str]:
    """What a function returns when another user of the machine calls it, in a process of its own."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setgid(OTHER)
            os.setuid(OTHER)
            os.write(writer, json.dumps(work()).encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as file:
        told: list[str] = json.loads(file.read())
    os.waitpid(child, 0)
    return told


def attempts(paths: list[Path], victim: Path) -> list[str]:
    """What this user can do with files and folders of another one."""
    done = []
    for path in paths:
        trials: dict[str, Callable[[], object]] = {
            "renamed": lambda path=path: path.rename(path.with_name(f"{path.name}.mine")),
            "removed": lambda path=path: path.unlink(),
        }
        if os.path.isdir(path):
            trials |= {
                "listed": lambda path=path: os.listdir(path),
                "planted in": lambda path=path: (path / "planted").symlink_to(victim),
            }
        trials["read"] = lambda path=path: os.open(path, os.O_RDONLY)
        trials["written"] = lambda path=path: os.open(path, os.O_WRONLY)
        trials["connected to"] = lambda path=path: socket.socket(socket.AF_UNIX).connect(str(path))
        for name, trial in trials.items():
            try:
                trial()
            except OSError:
                continue
            done.append(f"{name}: {path}")
    return done


def other_user(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """Beside a sweep at work; as often as there are files and folders."""
    fault = "another user of the machine"
    if os.geteuid() != 0:
        return [Tally(fault, 0, "not run: acting as another user needs root")]
    sweep = Sweep("other_user", scratch, reference.trials)
    sweep.launch()
    paths: list[Path] = []
    done: list[str] = []
    scratch.chmod(0o1777)  # as /tmp is
    if sweep.wait_for_rows(round(len(sweep.trials) * (EPOCHS + 1) * rng.uniform(0.1, 0.3))):
        paths = sorted(path for folder in scratch.glob("msk-*") for path in (folder, *folder.rglob("*")))
        done = as_another_user(lambda: attempts(paths, scratch))
    code = sweep.wait()
    scratch.chmod(0o700)
    tally = judge(reference, sweep, fault, len(paths), "nothing")
    tally.notes += done
    if code:
        tally.notes.append(f"exit code {code}")
    return [tally]


CAMPAIGNS: dict[str, Callable[[Reference, Path, random.Random], list[Tally]]] = {"other_user": other_user}
