"""A trial's name and id for loggers."""

import uuid
from pathlib import Path

from msk_ray.files import write_text


def run_name(folder: Path) -> tuple[str, str]:
    """The experiment and the trial: for `runs/NAME/trials/ID` NAME and ID, for `runs/train/NAME` train and NAME."""
    experiment = folder.parent.parent if folder.parent.name == "trials" else folder.parent
    return experiment.name, folder.name


def run_id(folder: Path, file: str) -> str:
    """An id that the trial keeps when it is resumed, stored in its folder.

    Raises:
        StorageFailure: the file cannot be written.
    """
    path = folder / file
    if not path.is_file():
        write_text(path, uuid.uuid4().hex)
    return path.read_text(encoding="utf-8").strip()
