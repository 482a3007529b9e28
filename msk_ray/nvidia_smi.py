"""The GPUs listed by the driver. Asking torch or Warp would allocate GPU memory in this process."""

import shutil
import subprocess
from dataclasses import dataclass


@dataclass(frozen=True)
class DriverView:
    """Report of nvidia-smi, regardless of CUDA_VISIBLE_DEVICES."""

    driver: str | None
    """Version of the driver; None without a working one."""
    gpus: tuple[str, ...]
    """Names, in the driver's order."""


def ask_driver(timeout_s: float = 30.0) -> DriverView:
    """Run nvidia-smi and wait at most `timeout_s` seconds for its answer."""
    if shutil.which("nvidia-smi") is None:
        return DriverView(None, ())
    query = ["nvidia-smi", "--query-gpu=driver_version,name", "--format=csv,noheader"]
    try:
        result = subprocess.run(query, capture_output=True, text=True, timeout=timeout_s)
    except subprocess.TimeoutExpired:
        return DriverView("that does not answer", ())
    lines = result.stdout.splitlines() if result.returncode == 0 else []
    answers = [line.split(", ", 1) for line in lines if ", " in line]
    return DriverView(answers[0][0], tuple(name for _, name in answers)) if answers else DriverView(None, ())
