"""The first error of a validation on one line, with what to write instead."""

import difflib
from collections.abc import Mapping
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from msk_ray.config.recorded import newer_spelling
from msk_ray.config.schema import Config
from msk_ray.errors import brief, shortened

_MAX_MESSAGE = 400


def describe_fault(
    error: ValidationError, root: type[BaseModel] = Config, *, named: Mapping[str, type[BaseModel]] | None = None
) -> str:
    """The first error of validating a `root`, and how many more there are.

    Args:
        error: the error that the validation raised.
        root: the class validated.
        named: open sections of `root`, dotted, with the class that each was validated as.
    """
    faults = error.errors()
    # A misspelt key often makes the right one missing too; report the misspelling.
    first = min(faults, key=lambda fault: fault["type"] != "extra_forbidden")
    text = shortened(" ".join(_text(first, root, named or {}).split()), _MAX_MESSAGE)
    more = len(faults) - 1
    return text + (f" (and {more} more error{'s' if more > 1 else ''})" if more else "")


def _text(fault: ErrorDetails, root: type[BaseModel], named: Mapping[str, type[BaseModel]]) -> str:
    location = [shortened(str(part)) for part in fault["loc"]]
    where = ".".join(location)
    match fault["type"]:
        case "extra_forbidden":
            return f"{where}: unknown key; {_instead(location, root, named)}"
        case "value_error":
            return str(fault["ctx"]["error"]) if "ctx" in fault else fault["msg"]
        case "missing":
            return f"{where}: missing; write it"
        case _:
            return f"{where}: {fault['msg']}, not {brief(fault['input'])}"


def _instead(location: list[str], root: type[BaseModel], named: Mapping[str, type[BaseModel]]) -> str:
    """What to write instead of an unknown key."""
    *sections, key = location
    if root is Config and (newer := newer_spelling(".".join(location))) is not None:
        return newer
    section = _model_at(root, sections, named)
    below = _subsection_with(section, key, named if section is root else {})
    if below is not None:
        return f"write {'.'.join([*sections, below, key])}"
    known = list(section.model_fields)
    near = difflib.get_close_matches(key, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(known)}"


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _subsection_with(section: type[BaseModel], key: str, named: Mapping[str, type[BaseModel]]) -> str | None:
    """The section within `section` that has a setting of this name."""
    for name, field in section.model_fields.items():
        kind = named.get(name, field.annotation)
        if _is_model(kind) and key in kind.model_fields:  # type: ignore[union-attr]
            return name
    return None


def _model_at(root: type[BaseModel], sections: list[str], named: Mapping[str, type[BaseModel]]) -> type[BaseModel]:
    """The settings class of the section of `root` that contains an error."""
    model: Any = root
    for depth, section in enumerate(sections):
        model = named.get(".".join(sections[: depth + 1]), model.model_fields[section].annotation)
        if not _is_model(model):  # it may be null
            model = next(option for option in get_args(model) if _is_model(option))
    model_there: type[BaseModel] = model
    return model_there
