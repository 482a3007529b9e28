"""What an experiment, or a trial on its own, ran with: versions, command, and the machine it was started on."""

import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

import msk_ray
from msk_ray.experiment.damage import WITH_COMMAND, Damage, DamagedFile, cut, field, read_object, texts
from msk_ray.nvidia_smi import ask_driver

_PACKAGES = ("msk-ray", "torch", "warp-lang", "mujoco", "mujoco-warp", "ray", "numpy")
_ENVIRONMENT = {
    "command": list,
    "python": str,
    "platform": str,
    "host": str,
    "cpus": int,
    "gpus": list,
    "driver": str,
    "packages": dict,
    "commit": str,
    "device": str,
    "deterministic": bool,
}


def read_environment(path: Path) -> tuple[dict[str, Any], list[Damage]]:
    """The recorded part of what an experiment ran with, and the damaged parts of its file.

    Raises:
        StorageFailure: the storage does not give it.
    """
    damages: list[Damage] = []

    def usable(data: dict[str, Any]) -> dict[str, Any]:
        values = {}
        for name in data.keys() & _ENVIRONMENT.keys():
            if data[name] is None:
                continue  # null: not known
            try:
                value: Any = field(data, name, _ENVIRONMENT[name])
                inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
                if not texts(inner):
                    raise ValueError(f"{name} holds something else than texts")
                values[name] = value
            except ValueError as error:
                damages.append(Damage(path, cut(error)))
        return {name: values[name] for name in _ENVIRONMENT if name in values}

    try:
        return read_object(path, usable, WITH_COMMAND) or {}, damages
    except DamagedFile as error:
        return {}, [error.damage]


def environment(device: str | None = None) -> dict[str, Any]:
    """What the experiment ran with: versions, command, and the machine it was started on.

    Args:
        device: for a single training run, its GPU's model or `cpu`; the trials of an experiment record their own.
    """
    driver = ask_driver()
    return {
        "command": sys.argv,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "host": platform.node(),
        "cpus": os.cpu_count(),
        "gpus": list(driver.gpus),
        "driver": driver.driver,
        "packages": installed_versions(_PACKAGES),
        "commit": _commit(),
        **({} if device is None else {"device": device}),
    }


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of those packages that are installed; a checkout on the path is not."""
    versions = {}
    for package in packages:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions


def _commit() -> str | None:
    """The checkout's commit, `+` for uncommitted changes; None outside a checkout."""
    root = Path(msk_ray.__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    try:
        head = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        changes = subprocess.run(
            ["git", "-C", str(root), "status", "--porcelain"], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        # git is not installed, or refuses a folder of another owner: the commit is unknown.
        return None
    return head.stdout.strip() + ("+" if changes.stdout.strip() else "")
