"""The file of MyoSuite's walking model. No torch: settings ask whether it is there."""

from pathlib import Path
from typing import Final

from msk_ray.errors import ConfigError
from msk_ray.legs.myoleg.source import INSTALL_OF, package_folder

VERSION: Final = "2.12"
"""Version of MyoSuite whose task this is."""
INSTALL: Final = f"{INSTALL_OF['myosuite2']}, or set env.model to the path of its myolegs.xml"
_FILE: Final = Path("simhive/myo_sim/leg/myolegs.xml")


def find_file(model: str | None) -> Path:
    """The model's file.

    Raises:
        ConfigError: there is no such file, or no MyoSuite of this version.
    """
    if model is not None:
        path = Path(model)
        if not path.is_file():
            raise ConfigError(f"env.model: no file {model}; {INSTALL}")
        return path
    found = package_folder("myosuite")
    if found is None:
        raise ConfigError(f"env.model: MyoSuite {VERSION} is not installed: {INSTALL}")
    folder, version = found
    if not version.startswith(f"{VERSION}.") or not (folder / _FILE).is_file():
        raise ConfigError(f"env.model: this is the task of MyoSuite {VERSION}, but {version} is installed: {INSTALL}")
    return folder / _FILE
