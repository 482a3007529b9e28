"""Where the Python of an environment apart from this one is; read before torch is loaded."""

from pathlib import Path
from typing import Final

from msk_ray.errors import ConfigError

PYTHON: Final = Path(".myosuite/bin/python")
"""Where the Python that has MyoSuite is looked for, in the current folder."""
INSTALL: Final = f"python -m venv .myosuite && .myosuite/bin/pip install myosuite==2.12.2, then --python {PYTHON}"


def find_python(path: Path | None) -> Path:
    """The Python at `path`, or that in `.myosuite`.

    Raises:
        ConfigError: there is no such file.
    """
    path = path or PYTHON
    if not path.is_file():
        raise ConfigError(f"--python: no file {path}; install MyoSuite beside msk_ray: {INSTALL}")
    return path
