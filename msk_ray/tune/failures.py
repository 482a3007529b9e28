"""Classifies exceptions of trials: where they come from, and whether a retry would meet them again."""

import re
import sysconfig
import traceback
from collections.abc import Iterator
from pathlib import Path

import msk_ray

_PACKAGE = Path(msk_ray.__file__).resolve().parent
_LIBRARIES = tuple(Path(sysconfig.get_path(name)).resolve() for name in ("purelib", "platlib"))
_PYTHON = Path(sysconfig.get_path("stdlib")).resolve()
_LASTING = (FileNotFoundError, FileExistsError, IsADirectoryError, NotADirectoryError, PermissionError)
"""File errors that a retry would meet again, if the user's own code has named the file."""
_DEVICE_ERRORS = {"AcceleratorError", "DistError", "OutOfMemoryError"}
"""Names of torch's exception classes; only trials import torch."""
_FRAME = re.compile(r'File "(.+)", line (\d+), in (\S+)')
_DEVICE_WORDS = re.compile(r"\b(CUDA|cuBLAS|cuDNN|NCCL|NVML)\b", re.IGNORECASE)


def repeats(error: BaseException) -> bool:
    """Whether a new process would most likely meet an exception again. Training is deterministic, so all but those of
    the operating system, devices, other processes and Ray."""
    classes = type(error).__mro__
    if isinstance(error, MemoryError) or any(of.__module__.partition(".")[0] == "ray" for of in classes):
        return False
    if any(of.__name__ in _DEVICE_ERRORS for of in classes):
        return False
    if isinstance(error, RuntimeError) and _DEVICE_WORDS.search(str(error)):
        return False
    if isinstance(error, OSError):
        callers = [frame for frame in _frames(error) if not _in_python(frame)]
        return isinstance(error, _LASTING) and bool(callers) and _is_own(callers[-1])
    return True


def described(error: BaseException) -> str:
    """An exception on one line, with file and line, if possible in the user's own code."""
    if isinstance(error, SystemExit):
        text = f"sys.exit({error.code!r}) was called"
    else:
        lines = str(error).strip().splitlines()
        text = ": ".join([type(error).__name__, *lines[:1]])
    frames = list(_frames(error))
    own = [frame for frame in frames if _is_own(frame)]
    package = [frame for frame in frames if _PACKAGE in Path(frame.filename).parents]
    for candidates in (own, package, frames):
        if candidates:
            frame = candidates[-1]
            return f"{text} ({Path(frame.filename).name}:{frame.lineno}, in {frame.name})"
    return text


def _frames(error: BaseException) -> Iterator[traceback.FrameSummary]:
    """The call stack of an exception, outermost first; a part in another process is in its notes."""
    yield from traceback.extract_tb(error.__traceback__)
    for note in getattr(error, "__notes__", ()):
        for filename, line, name in _FRAME.findall(note):
            yield traceback.FrameSummary(filename, int(line), name)


def _is_own(frame: traceback.FrameSummary) -> bool:
    """Whether a frame is neither in this package, nor in a library, nor in Python itself."""
    path = Path(frame.filename)
    return path.is_absolute() and not _in_python(frame) and not any(f in path.parents for f in (_PACKAGE, *_LIBRARIES))


def _in_python(frame: traceback.FrameSummary) -> bool:
    path = Path(frame.filename)
    return frame.filename.startswith("<") or (
        _PYTHON in path.resolve().parents and not any(folder in path.parents for folder in _LIBRARIES)
    )
