"""Runs a command beside processes that only compute, and names the processes it leaves behind.

    python benchmarks/busy.py make test             # beside six of them
    python benchmarks/busy.py --loops 0 make test   # on an idle machine

Every process started by the command inherits an environment variable, by which those that outlive it are found (Linux).
"""

import argparse
import os
import secrets
import signal
import subprocess
import sys
import time
from pathlib import Path

from fault_campaign.processes import name_of

VARIABLE = "MSK_RAY_BUSY"
GRACE_S = 60.0
"""What is ending when the command ends is left to end for this long."""


def left_behind(mark: str) -> list[int]:
    """The processes that were started with the environment variable, oldest number first."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            if f"{VARIABLE}={mark}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                found.append(int(entry.name))
        except OSError:  # it has ended, or belongs to another user
            continue
    return sorted(found)


def main() -> int:
    """Run the command; its exit code, or 1 if it left processes behind."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--loops", type=int, default=6, help="processes that compute without end, by default 6")
    p.add_argument("command", nargs=argparse.REMAINDER, help="what to run beside them")
    args = p.parse_args()
    if not args.command:
        p.error("which command? For example: python benchmarks/busy.py make test")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the loops end too
    mark = secrets.token_hex(8)
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(args.loops)]
    started = time.monotonic()
    try:
        code = subprocess.run(args.command, env=os.environ | {VARIABLE: mark}).returncode
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
    seconds = time.monotonic() - started
    until = time.monotonic() + GRACE_S
    while (left := left_behind(mark)) and time.monotonic() < until:
        time.sleep(1.0)
    names = ", ".join(f"{pid} {name_of(pid)}" for pid in left) or "none"
    print(f"exit code {code} after {seconds:.0f} s beside {args.loops} busy loops; processes left behind: {names}")
    return code or bool(left)


if __name__ == "__main__":
    sys.exit(main())
