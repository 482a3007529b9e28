"""Optional dependencies: this package's extras."""

from collections.abc import Mapping
from importlib.util import find_spec

from msk_ray.errors import ConfigError


def require(packages: Mapping[str, str], user: str) -> None:
    """Raise if packages are not installed, without importing them.

    Args:
        packages: module → argument of `pip install`.
        user: the setting that needs them, with its value.

    Raises:
        ConfigError: the message names what to install.
    """
    for module, install in packages.items():
        if find_spec(module) is None:
            raise ConfigError(f"{user} needs the package {module}, which is not installed: pip install '{install}'")
