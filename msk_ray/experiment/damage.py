"""Reading an experiment's files, which may be damaged or come from anywhere: unusable parts are reported with file and
line, and do not hide the rest.

A file that is not regular, or exceeds its `Limits`, counts as damaged, so that it neither blocks nor fills the memory.

The consequences of a damaged file:

| file | what is damaged | consequence |
|---|---|---|
| `metrics.jsonl` | a line | the line is skipped and counted; a trial that continues rewrites the file without it |
| `reports.jsonl` | a line | the line is skipped and counted; the stopping rule is told the others |
| both | the last line, incomplete | left by a killed writer: dropped silently |
| both | the file (no regular file, too large) | tables go without it; what continues from it is refused |
| `owner.json` | the file | its owner is judged by the file's age alone |
| `outcome.json` | the file | the trial counts as not ended: it continues from its newest checkpoint and ends again |
| `device.json` | the file | the device is unknown |
| `halved.json` | the file | the trial ends in an error until it is repaired: its number of worlds is unknown |
| `params.json` | the file | `--resume` is refused: the search's choice is unknown; remove the trial's folder |
| `manifest.json` | the file | refused, except by `report`, which shows what the trials' folders hold |
| `env.json` | the file, a field | versions and command are unknown |
| `notes.json` | the file | notes are not shown, and none is written until it is repaired or removed |
| `eval.json` | the file, an entry | refused: remove it to have it written again |
| a checkpoint | the file | skipped in favour of the one before; `best.pt` is refused when it is needed |
| `unscored_*.pt` | the file | its policy gets no score; a resumed trial says so |

`summary.json`, `table.md` and the report are written and never read.
"""

import contextlib
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import orjson

from msk_ray.config import parse_settings
from msk_ray.errors import StorageError, StorageFailure
from msk_ray.files import UnusableFile, read_file

T = TypeVar("T")
_TEXT_LIMIT = 100


@dataclass(frozen=True)
class Limits:
    """Limits on the size of a file."""

    size: int
    """Bytes."""
    count: int
    """Values, or lines of a file of lines."""
    undecodable: bool = False
    """Whether texts may contain escaped bytes that are not UTF-8, as command-line arguments may."""


RECORD = Limits(16 << 20, 200_000)
"""Limits of a file about one trial, owner or machine."""
WITH_COMMAND = Limits(16 << 20, 200_000, undecodable=True)
"""The same for a file with a command line in it."""
CATALOGUE = Limits(512 << 20, 20_000_000)
"""Limits of a file with an entry for each trial of an experiment."""
LOG = Limits(512 << 20, 4_000_000)
"""Limits of a file of lines."""
LINE = Limits(1 << 20, 10_000)
"""Limits of one of its lines."""
_SURROGATE = re.compile(rb"\\u[dD][89A-Fa-f]")
DEPTH = 32
"""Largest nesting depth of objects and lists, in any file."""


@dataclass(frozen=True)
class Damage:
    """An unusable part of a file."""

    path: Path
    what: str
    line: int | None = None
    """Counted from 1; None if the whole file is damaged."""

    def __str__(self) -> str:
        return f"{self.path}{'' if self.line is None else f', line {self.line}'}: {self.what}"


class DamagedFile(StorageError):
    """A file has unusable content."""

    def __init__(self, damage: Damage, advice: str = "") -> None:
        super().__init__(damage, advice)  # both arguments, so that the error survives pickling between processes
        self.damage = damage
        self.advice = advice

    def __str__(self) -> str:
        return f"{self.damage}{f'; {self.advice}' if self.advice else ''}"


def describe_damages(damages: Sequence[Damage], root: Path) -> list[str]:
    """A line for each damaged file, with its path relative to `root`, the number of skipped lines, and what is wrong
    with the first one."""
    files: dict[Path, list[Damage]] = {}
    for damage in damages:
        files.setdefault(damage.path, []).append(damage)
    lines = []
    for path, in_file in files.items():
        first = in_file[0]
        name = Path(os.path.relpath(path, root)).as_posix()
        if first.line is None:
            lines.append(f"{name}: {first.what}")
        else:
            count = "1 line" if len(in_file) == 1 else f"{len(in_file)} lines"
            lines.append(f"{name}: {count} skipped; line {first.line}: {first.what}")
    return lines


def count_damages(damages: Sequence[Damage]) -> str:
    """`3 damaged lines and 1 damaged file`; empty if there are none."""
    lines = sum(damage.line is not None for damage in damages)
    counts = ((lines, "line"), (len(damages) - lines, "file"))
    return " and ".join(f"{n} damaged {what}{'' if n == 1 else 's'}" for n, what in counts if n)


def read_bytes(path: Path, limits: Limits = RECORD) -> bytes | None:
    """The content of a file; None if there is no such file.

    Raises:
        DamagedFile: it is not a regular file, or exceeds the limit.
        StorageFailure: the storage does not give it.
    """
    try:
        return read_file(path, limits.size)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except UnusableFile as error:
        raise DamagedFile(Damage(path, str(error))) from None
    except OSError as error:
        raise StorageFailure(f"cannot read {path}: {error.strerror or error}") from error


def read_text(path: Path) -> str:
    """The text in a file.

    Raises:
        DamagedFile: there is no such file, it cannot be used, or it is not UTF-8.
        StorageFailure: the storage does not give it.
    """
    data = read_bytes(path)
    if data is None:
        raise DamagedFile(Damage(path, "missing"))
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DamagedFile(Damage(path, _not_text(error))) from None


def read_settings(path: Path) -> dict[str, Any]:
    """The settings in a YAML file of an experiment or trial.

    Raises:
        DamagedFile: as for `read_text`.
        ConfigError: it is not YAML, or holds something else.
        StorageFailure: the storage does not give it.
    """
    return parse_settings(read_text(path), str(path))


def read_object(path: Path, build: Callable[[dict[str, Any]], T], limits: Limits = RECORD) -> T | None:
    """The value stored as a JSON object in a file; None if there is no such file.

    Args:
        build: creates the value from the object; raises ValueError that says what is wrong.

    Raises:
        DamagedFile: it cannot be used.
        StorageFailure: the storage does not give it.
    """
    data = read_bytes(path, limits)
    if data is None:
        return None
    try:
        return build(parse_object(data, limits))
    except ValueError as error:
        raise DamagedFile(Damage(path, cut(error))) from error


def read_lines(path: Path, build: Callable[[dict[str, Any]], T]) -> tuple[list[T], tuple[Damage, ...]]:
    """The values stored as JSON objects in the lines of a file, and the lines that cannot be used.

    An unusable last line without a line end comes from a writer that is still writing or was killed; it is ignored.

    Args:
        build: creates a value from a line's object; raises ValueError that says what is wrong.

    Raises:
        DamagedFile: it is not a regular file, or exceeds the limits.
        StorageFailure: the storage does not give it.
    """
    data = read_bytes(path, LOG) or b""
    if data.count(b"\n") > LOG.count:
        raise DamagedFile(Damage(path, f"more than {LOG.count} lines"))
    lines = data.split(b"\n")
    unfinished = lines.pop()
    values: list[T] = []
    damages = []
    for number, line in enumerate(lines, start=1):
        try:
            values.append(build(parse_object(line, LINE)))
        except ValueError as error:
            damages.append(Damage(path, cut(error), number))
    if unfinished:
        with contextlib.suppress(ValueError):  # an incomplete last line is ignored
            values.append(build(parse_object(unfinished, LINE)))
    return values, tuple(damages)


def _load(data: bytes, undecodable: bool) -> Any:
    try:
        return orjson.loads(data)
    except orjson.JSONDecodeError:
        # orjson does not accept NaN, and its messages are less precise.
        value = json.loads(data.decode("utf-8"))
    if not undecodable and _SURROGATE.search(data):
        try:
            json.dumps(value, ensure_ascii=False).encode()
        except UnicodeEncodeError:
            raise ValueError("a lone surrogate, which no page could show") from None
    return value


def parse_object(data: bytes, limits: Limits = RECORD) -> dict[str, Any]:
    """Parse a JSON object. Also accepts NaN and infinity, which JSON does not have.

    Raises:
        ValueError: it is not a JSON object, or exceeds the limits; the message says why.
    """
    if len(data) > limits.size:
        raise ValueError(f"larger than {limits.size} bytes")
    opened = data.count(b"[") + data.count(b"{")
    # An upper bound on the number of values, checked before parsing creates any of them.
    if opened + data.count(b",") > limits.count:
        raise ValueError(f"more than {limits.count} values")
    try:
        value = _load(data, limits.undecodable)
    except UnicodeDecodeError as error:
        raise ValueError(_not_text(error)) from None
    except json.JSONDecodeError as error:
        raise ValueError(f"not JSON: {error}") from None
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    if not isinstance(value, dict):
        raise ValueError(f"{_kind(value)} instead of a JSON object")
    if opened > DEPTH and _deeper_than(DEPTH, value):
        raise ValueError(_TOO_DEEP)
    return value


_TOO_DEEP = f"more than {DEPTH} objects and lists inside each other"


def _deeper_than(limit: int, value: dict[str, Any]) -> bool:
    level: list[dict[str, Any] | list[Any]] = [value]
    for _ in range(limit):
        parts = chain.from_iterable(part.values() if isinstance(part, dict) else part for part in level)
        level = [part for part in parts if isinstance(part, dict | list)]
        if not level:
            return False
    return True


def _not_text(error: UnicodeDecodeError) -> str:
    return f"not UTF-8 text: byte {error.start} is {error.object[error.start]:#04x}"


def field(data: Mapping[str, Any], name: str, kind: type[T]) -> T:
    """A field of an object, of type `kind`; true and false are not numbers.

    Raises:
        ValueError: it is missing or of another kind.
    """
    if name not in data:
        raise ValueError(f"{name} is missing")
    value = data[name]
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ValueError(f"{name} is {_kind(value)} instead of {_KINDS[kind]}")
    return value


def number(data: Mapping[str, Any], name: str) -> float:
    """A field that is a finite number.

    Raises:
        ValueError: it is missing, or not a finite number.
    """
    if name not in data:
        raise ValueError(f"{name} is missing")
    value = data[name]
    if not is_number(value):
        raise ValueError(f"{name} is {_kind(value)} instead of a finite number")
    return float(value)


def is_number(value: Any) -> bool:
    """Whether a value is a finite number that fits a float; true and false are not numbers."""
    if type(value) is float:
        return math.isfinite(value)
    return type(value) is int and -(10**300) < value < 10**300


def texts(values: Iterable[Any]) -> bool:
    """Whether all values are texts."""
    return all(isinstance(value, str) for value in values)


def cut(error: object) -> str:
    """A message cut to one short line."""
    text = " ".join(str(error).split())
    return text if len(text) <= _TEXT_LIMIT else text[: _TEXT_LIMIT - 1] + "…"


_KINDS: dict[Any, str] = {
    str: "text",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    list: "a list",
    dict: "an object",
    type(None): "null",
}


def _kind(value: Any) -> str:
    return _KINDS[type(value)]
