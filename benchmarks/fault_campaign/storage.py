"""The storage goes away while a sweep runs: moved, not mounted any more, or read-only."""

import random
import subprocess
import time
from pathlib import Path

from fault_campaign.reference import Reference
from fault_campaign.sweep import Sweep
from fault_campaign.tally import RESUMABLE, Tally, judge, strike


def gone(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """The experiment's folder is moved away until the driver has ended; nothing may be made in its place."""
    sweep = Sweep("gone", scratch, reference.trials)
    remade = []

    def blow() -> int:
        elsewhere = sweep.path.with_name("elsewhere")
        sweep.path.rename(elsewhere)
        code = sweep.wait()
        if sweep.path.exists():
            remade.append(sorted(path.name for path in sweep.path.iterdir()))
            sweep.path.rename(sweep.path.with_name(f"remade_{len(remade)}"))
        elsewhere.rename(sweep.path)
        return code

    injected, codes = strike(sweep, rng, 2, blow)
    tally = judge(reference, sweep, "experiment moved away", injected, "--resume")
    if remade:
        tally.notes.append(f"made in its place: {remade}")
    return [_with_codes(tally, codes)]


def read_only(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """The storage can be read and not be written (a read-only mount over it) until the driver has ended."""
    disk = scratch / "read_only"
    disk.mkdir()
    if subprocess.run(["mount", "--bind", str(disk), str(disk)]).returncode:
        return [Tally("read-only storage", 0, "not run: mounting needs root")]
    subprocess.run(["umount", str(disk)], check=True)
    sweep = Sweep("read_only", scratch, reference.trials, storage=disk)

    def blow() -> int:
        subprocess.run(["mount", "--bind", str(disk), str(disk)], check=True)
        try:
            # Busy while a process has a file open for writing that it opened through this mount.
            while subprocess.run(["mount", "-o", "remount,ro,bind", str(disk)], stderr=subprocess.DEVNULL).returncode:
                time.sleep(0.05)
            return sweep.wait()
        finally:
            # A process on its way out may still have a file of it open.
            subprocess.run(["umount", "--lazy", str(disk)], check=True)

    injected, codes = strike(sweep, rng, 2, blow)
    return [_with_codes(judge(reference, sweep, "read-only storage", injected, "--resume"), codes)]


def _with_codes(tally: Tally, codes: list[int]) -> Tally:
    if set(codes) != {RESUMABLE}:
        tally.notes.append(f"exit codes {codes} instead of {RESUMABLE}")
    return tally
