"""Packages that are needed only by those who use them: the extras of this package."""

from collections.abc import Mapping
from importlib.util import find_spec

from msk_ray.errors import ConfigError


def require(packages: Mapping[str, str], user: str) -> None:
    """Refuse what needs packages that are not installed, without importing any.

    Args:
        packages: module → what `pip install` takes.
        user: the setting that needs them, with its value.

    Raises:
        ConfigError: the message names what to install.
    """
    for module, install in packages.items():
        if find_spec(module) is None:
            raise ConfigError(f"{user} needs the package {module}, which is not installed: pip install '{install}'")
