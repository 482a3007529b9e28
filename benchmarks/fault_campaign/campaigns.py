"""The faults, a function each, and what became of the sweeps they struck."""

import contextlib
import os
import random
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

from fault_campaign.damaged_records import damaged_records
from fault_campaign.reference import Reference
from fault_campaign.replacements import replacements
from fault_campaign.space import BODIES, EPOCHS
from fault_campaign.storage import gone, read_only
from fault_campaign.sweep import Sweep
from fault_campaign.tally import RESUMABLE, Tally, judge, strike
from msk_ray.config import dump_yaml
from msk_ray.experiment.outcomes import read_ending
from msk_ray.sweep.space import load_space
from msk_ray.sweep.trials import resolve_trials

DISK_MIB = 48


def inside_workers(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """Deaths and hangs of trial processes; Ray tries them again by itself."""
    sweep = Sweep("workers", scratch, reference.trials)
    kinds = {
        "worker SIGKILL before an epoch": ("kill", sorted(rng.sample(range(2, EPOCHS + 1), 4))),
        # The first one strikes before there is any checkpoint.
        "worker SIGKILL in the middle of a row": ("torn_row", [1, *sorted(rng.sample(range(2, EPOCHS), 3))]),
        "worker SIGKILL in the middle of a checkpoint": (
            "torn_checkpoint",
            [*sorted(rng.sample(range(2, EPOCHS, 2), 3)), EPOCHS],
        ),
        "hang": ("hang", sorted(rng.sample(range(2, EPOCHS + 1), 2))),
    }
    for trial, (kind, epochs) in zip(sweep.trials, kinds.values(), strict=True):
        sweep.plant(trial, dict.fromkeys(epochs, kind))
    sweep.launch()
    code = sweep.wait()
    tallies = []
    for trial, name in zip(sweep.trials, kinds, strict=True):
        tallies.append(judge(reference, sweep, name, sweep.struck(trial), "nothing", [trial]))
        if code != 0:
            tallies[-1].notes.append(f"exit code {code}")
    return tallies


def nan(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """A policy becomes NaN: the trial ends there with that outcome, and continues from its checkpoint on request."""
    sweep = Sweep("nan", scratch, reference.trials)
    for trial in sweep.trials:
        sweep.plant(trial, {rng.randrange(2, EPOCHS + 1): "nan"})
    sweep.launch()
    sweep.wait()
    endings = [read_ending(sweep.path / "trials" / trial.id) for trial in sweep.trials]
    named = sum(ending is not None and ending.outcome == "nonfinite" for ending in endings)
    sweep.launch("--retry", "nonfinite")
    sweep.wait()
    injected = sum(map(sweep.struck, sweep.trials))
    tally = judge(reference, sweep, "NaN in the policy", injected, "--resume --retry nonfinite")
    if named != injected:
        tally.notes.append(f"{injected - named} of them were not named nonfinite: {endings}")
    return [tally]


def killed(
    reference: Reference,
    scratch: Path,
    rng: random.Random,
    name: str,
    times: int,
    number: signal.Signals,
    daemon: str | None = None,
) -> list[Tally]:
    """The driver or a daemon of its Ray dies several times in one sweep."""
    sweep = Sweep(name.replace(" ", "_"), scratch, reference.trials)
    injected, codes = strike(sweep, rng, times, lambda: sweep.kill(number, daemon))
    tally = judge(reference, sweep, name, injected, "--resume")
    if (number == signal.SIGTERM or daemon is not None) and set(codes) != {RESUMABLE}:
        tally.notes.append(f"exit codes {codes} instead of {RESUMABLE}")
    return [tally]


def damaged(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """The driver dies, and with it the newest checkpoint of every trial that ran."""

    def truncate(path: Path) -> None:
        os.truncate(path, path.stat().st_size // 3)

    def zero(path: Path) -> None:
        path.write_bytes(bytes(path.stat().st_size))

    def lose(path: Path) -> None:
        path.unlink()

    kinds = {"truncated": truncate, "zeroed": zero, "missing": lose}
    waiting = list(kinds)
    hit = dict.fromkeys(kinds, 0)
    sweep = Sweep("damaged_checkpoints", scratch, reference.trials)

    def blow() -> int:
        code = sweep.kill(signal.SIGKILL)
        sweep.leftovers()  # else a dying trial may still write a whole one
        # The kinds in turn; a strike before any checkpoint hits nothing, and its kind has its turn again.
        name = waiting.pop(0) if waiting else min(hit, key=hit.__getitem__)
        for trial in sweep.running():
            found = sorted((sweep.path / "trials" / trial.id / "checkpoints").glob("epoch_*.pt"))
            if found:
                kinds[name](found[-1])
                hit[name] += 1
        if not hit[name]:
            waiting.insert(0, name)
        return code

    strike(sweep, rng, len(kinds) + 2, blow)
    return [
        judge(reference, sweep, f"driver SIGKILL and newest checkpoint {name}", hit[name], "--resume") for name in kinds
    ]


def full_disk(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """The storage has no byte left (a small tmpfs, filled up) until the driver has ended."""
    disk = scratch / "disk"
    disk.mkdir()
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "tmpfs", str(disk)])
    if mount.returncode:
        return [Tally("full disk", 0, "not run: mounting a tmpfs needs root")]
    try:
        sweep = Sweep("full_disk", scratch, reference.trials, storage=disk)
        ballast = disk / "ballast"

        def blow() -> int:
            with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:
                while True:  # until it raises: no space left
                    file.write(bytes(4096))
            code = sweep.wait()
            ballast.unlink()
            return code

        injected, codes = strike(sweep, rng, 2, blow)
        tally = judge(reference, sweep, "full disk", injected, "--resume")
        if set(codes) != {RESUMABLE}:
            tally.notes.append(f"exit codes {codes} instead of {RESUMABLE}")
        return [tally]
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def bodies(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """The driver of a sweep over two bodies and two algorithms dies twice."""
    folder = scratch / "bodies"
    folder.mkdir()
    (folder / "space.yaml").write_text(dump_yaml(BODIES))
    alone = Reference(resolve_trials(load_space(folder / "space.yaml")), folder / "reference")
    sweep = Sweep("bodies", folder, alone.trials)
    injected, _ = strike(sweep, rng, 2, lambda: sweep.kill(signal.SIGKILL))
    return [judge(alone, sweep, "driver SIGKILL, two bodies by two algorithms", injected, "--resume")]


CAMPAIGNS: dict[str, Callable[[Reference, Path, random.Random], list[Tally]]] = {
    "replacements": replacements,
    "records": damaged_records,
    "gone": gone,
    "read-only": read_only,
    "disk": full_disk,
    "raylet": lambda *a: killed(*a, "raylet SIGKILL", 3, signal.SIGKILL, "raylet"),
    "gcs": lambda *a: killed(*a, "gcs_server SIGKILL", 3, signal.SIGKILL, "gcs_server"),
    "nan": nan,
    "workers": inside_workers,
    "checkpoints": damaged,
    "sigterm": lambda *a: killed(*a, "driver SIGTERM", 3, signal.SIGTERM),
    "driver": lambda *a: killed(*a, "driver SIGKILL", 3, signal.SIGKILL),
    "bodies": bodies,
}
