"""Device, driver and package versions, on which the bits of a trial's results depend besides its settings."""

import platform
from pathlib import Path
from typing import Any

import torch

from msk_ray.experiment.layout import ENVIRONMENT_FILE
from msk_ray.experiment.provenance import installed_versions, read_environment
from msk_ray.files import write_json
from msk_ray.nvidia_smi import ask_driver

_PACKAGES = ("msk-ray", "torch", "warp-lang", "mujoco", "mujoco-warp")


def device_name(device: str) -> str:
    """`cpu`, or a GPU's model."""
    return str(torch.cuda.get_device_name(device)) if device.startswith("cuda") else "cpu"


def machine(device: str, deterministic: bool) -> dict[str, Any]:
    """Device, driver, versions, and whether the trial is meant to repeat bit for bit."""
    return {
        "device": device_name(device),
        "driver": ask_driver().driver if device.startswith("cuda") else None,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": installed_versions(_PACKAGES),
        "deterministic": deterministic,
    }


def record_machine(folder: Path, device: str, deterministic: bool) -> None:
    """Write the trial's `env.json`, unless it has one."""
    path = folder / ENVIRONMENT_FILE
    if not path.exists():
        write_json(path, machine(device, deterministic))


def machine_differences(folder: Path, device: str) -> str | None:
    """How this machine differs from the one that the trial began on, as text; None if no difference is known."""
    before, _ = read_environment(folder / ENVIRONMENT_FILE)
    differences, name = [], device_name(device)
    if before.get("device", name) != name:
        differences.append(f"{before['device']}, now {name}")
    now = installed_versions(_PACKAGES)
    for package, version in before.get("packages", {}).items():
        if package in _PACKAGES[1:] and version != now.get(package):
            differences.append(f"{package} {version}, now {now.get(package)}")
    return "; ".join(differences) or None
