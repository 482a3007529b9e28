"""Finding classes named in a configuration, by a short name or as `package.module:Class`, here and in processes that
are started here."""

import difflib
import os
import traceback
from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar

from msk_ray.errors import ConfigError, brief

T = TypeVar("T")


def resolve(path: str, key: str) -> Any:
    """The object at the import path `package.module:Name`.

    Args:
        path: the import path.
        key: the setting that contains it, for errors.

    Raises:
        ConfigError: the path is malformed, the module is not found or fails to import, or it has no such name.
    """
    module_name, _, attribute = path.partition(":")
    if not all(part.isidentifier() for part in (*module_name.split("."), attribute)):
        raise ConfigError(f"{key}: write package.module:Class, not {brief(path)}")
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise _broken(module_name, key, error) from error
        raise ConfigError(
            f"{key}: no module {error.name!r}; the current folder, PYTHONPATH and installed packages are searched"
        ) from None
    except Exception as error:
        raise _broken(module_name, key, error) from error
    if not hasattr(module, attribute):
        classes = [name for name, value in vars(module).items() if isinstance(value, type)]
        near = difflib.get_close_matches(attribute, classes, n=1)
        own = [name for name in classes if getattr(module, name).__module__ == module.__name__]
        hint = f"did you mean {near[0]!r}?" if near else f"its classes: {', '.join(own) or 'none'}"
        raise ConfigError(f"{key}: module {module_name} has no {attribute!r}; {hint}")
    return getattr(module, attribute)


def resolve_class(path: str, key: str, base: type[T]) -> type[T]:
    """The class at an import path, a subclass of `base`.

    Raises:
        ConfigError: as for `resolve`, or the object is not a subclass, or does not implement all methods of `base`.
    """
    target = resolve(path, key)
    wanted = f"{base.__module__}.{base.__qualname__}"
    if not (isinstance(target, type) and issubclass(target, base)):
        raise ConfigError(f"{key}: {path} is not a subclass of {wanted}")
    lacking = sorted(getattr(target, "__abstractmethods__", ()))
    if lacking:
        raise ConfigError(f"{key}: {path} lacks {', '.join(lacking)}: write what {wanted} describes")
    return target


def _broken(module: str, key: str, error: Exception) -> ConfigError:
    frames = traceback.extract_tb(error.__traceback__)
    text = (str(error).splitlines() or [""])[0]
    return ConfigError(
        f"{key}: importing {module} failed: {type(error).__name__}: {text} ({frames[-1].filename}:{frames[-1].lineno})"
    )


def python_path() -> str:
    """`PYTHONPATH` for a process that must import this package too: its folder before what is there."""
    package = str(Path(__file__).resolve().parent.parent)
    return os.pathsep.join(dict.fromkeys([package, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]))


class Registry:
    """Import paths by short name: the package's own, and those of installed packages.

    Another package cannot take one of the package's own names.

    Args:
        key: the setting that takes the names, for errors.
        group: the entry-point group in which installed packages declare theirs.
        own: the package's own names.
    """

    def __init__(self, key: str, group: str, own: Mapping[str, str]) -> None:
        self.key = key
        self._group = group
        self._own = dict(own)

    def known(self) -> list[str]:
        """Every short name."""
        return list(dict.fromkeys([*self._own, *(point.name for point in entry_points(group=self._group))]))

    def find(self, name: str) -> str | None:
        """The import path of a short name; None if the name is unknown.

        Raises:
            ConfigError: several installed packages declare it.
        """
        if name in self._own:
            return self._own[name]
        paths = sorted({point.value for point in entry_points(group=self._group, name=name)})
        if len(paths) > 1:
            raise ConfigError(f"{self.key} {name!r} is declared by several packages: write {' or '.join(paths)}")
        return paths[0] if paths else None

    def path(self, name: Any) -> str:
        """The import path of a short name, or `name` itself if it is one.

        Raises:
            ConfigError: the short name is unknown.
        """
        known = self.known
        if not isinstance(name, str):
            what = "missing" if name is None else f"{brief(name)} is no name"
            raise ConfigError(f"{self.key}: {what}; write {', '.join(known())} or package.module:Class")
        if ":" in name:
            return name
        path = self.find(name)
        if path is None:
            near = difflib.get_close_matches(name, known(), n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"write {', '.join(known())} or package.module:Class"
            raise ConfigError(f"{self.key}: unknown name {brief(name)}; {hint}")
        return path
