"""An experiment has one driver at a time."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from msk_ray.errors import StorageError
from msk_ray.files import check_writable, make_folder
from msk_ray.ownership import Ownership, owned
from msk_ray.tune.experiment import refuse_old


@contextlib.contextmanager
def own(path: Path, *, new: bool, force: bool = False) -> Iterator[Ownership]:
    """Own an experiment's folder for a block, before anything in it is written.

    Args:
        path: its folder; made here for a new one.
        new: whether the experiment is to be begun, not gone on with.
        force: take it over from a driver that looks alive.

    Raises:
        StorageError: there is an experiment already, or none; another driver is at work; the folder cannot be written.
    """
    if new:
        refuse_old(path)
        make_folder(path)
    elif not path.is_dir():
        raise StorageError(f"no experiment at {path} to go on with; leave --resume and --extend out to start one")
    else:
        check_writable(path)
    with owned(path, force) as ownership:
        yield ownership
