"""Record a benchmark's table with device, versions and command, and append it to the results."""

import datetime
import os
import platform
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

RESULTS = Path(__file__).parent / "results"
PACKAGES = ("torch", "warp-lang", "mujoco", "mujoco-warp")


def device_name(device: str) -> str:
    """Marketing name of the device a benchmark ran on, with the processors torch may use."""
    import torch

    if device.startswith("cuda"):
        return str(torch.cuda.get_device_name(device))
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores, {torch.get_num_threads()} torch threads"


def used_bytes(device: "torch.device") -> int:
    """Memory in use on a GPU, by everyone; 0 on CPU."""
    import torch

    if device.type != "cuda":
        return 0
    torch.cuda.synchronize(device)
    torch.cuda.empty_cache()
    free, total = torch.cuda.mem_get_info(device)
    return int(total - free)


def commit() -> str:
    """Short git commit of the working tree, with -dirty if anything but results differs from it; outside a clone what
    MSK_RAY_COMMIT says, or "unknown"."""
    if "MSK_RAY_COMMIT" in os.environ:
        return os.environ["MSK_RAY_COMMIT"]
    try:
        # The tables themselves, of which one run appends several, are no change of what is measured.
        changed = _git("diff", "HEAD", "--name-only", "--", ".", ":!benchmarks/results")
        return _git("rev-parse", "--short", "HEAD") + ("-dirty" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*arguments: str) -> str:
    root = Path(__file__).parents[1]
    return subprocess.run(["git", *arguments], capture_output=True, text=True, cwd=root, check=True).stdout.strip()


def markdown_table(header: list[str], rows: list[list[str]]) -> str:
    """A table with numbers right-aligned."""
    lines = ["| " + " | ".join(header) + " |", "|" + " ---: |" * len(header)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def publish(name: str, title: str, device: str, table: str, results: Path = RESULTS) -> Path:
    """Print a table and append it to results/NAME.md with what it takes to repeat it."""
    packages = ", ".join(f"{package} {version(package)}" for package in PACKAGES)
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    text = (
        f"## {title}\n\n{today}, {device_name(device)}; {packages}; Python {platform.python_version()}; "
        f"commit {commit()}\n\n`python {' '.join(map(shlex.quote, sys.argv))}`\n\n{table}\n"
    )
    print(text)
    results.mkdir(parents=True, exist_ok=True)
    path = results / f"{name}.md"
    with path.open("a", encoding="utf-8") as file:
        file.write(text + "\n")
    print(f"appended to {path}")
    return path
