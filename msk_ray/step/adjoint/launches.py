"""Launches of kernels whose arguments are found by their names and types, as `gather` finds the fields of a group."""

from collections.abc import Callable
from operator import attrgetter
from typing import Any

import warp as wp

from msk_ray.step.adjoint.groups import State, gather

_Source = Callable[[Any, tuple[Any, ...], dict[str, Any]], Any]
"""Gives an argument from the substep, the caller's groups and what the caller names."""


def _has(holder: Any, path: str) -> bool:
    for name in path.split("."):
        if not hasattr(holder, name):
            return False
        holder = getattr(holder, name)
    return True


def _attribute_of_kind(holder: Any, kind: Any) -> str | None:
    return next((name for name, value in vars(holder).items() if getattr(value, "_cls", None) is kind), None)


class Launcher:
    """Launches kernels of one model's adjoint.

    An array or number called `x`, `x_in`, `x_out` or `opt_x` is the attribute x of the first that has one: what the
    caller names, the workspace, its settings, its tables, the model, its options, the substep, its Data. A group is the
    one of its type that the caller, the workspace or the substep has; else its fields are found one by one in the
    tables, the model, its options and the Data.

    Args:
        work: the workspace.
    """

    def __init__(self, work: Any) -> None:
        self._work = work
        self._sources: dict[Any, list[_Source]] = {}

    def __call__(self, kernel: Any, dim: Any, at: Any, *groups: Any, **named: Any) -> None:
        """Launch a kernel at a substep, None if it reads none.

        Raises:
            AttributeError: nothing has an argument's name, or that of a field of a group.
        """
        key = (kernel, *(group._cls for group in groups), *named)
        if key not in self._sources:
            self._sources[key] = [self._source(arg.label, arg.type, at, groups, named) for arg in kernel.adj.args]
        wp.launch(kernel, dim=dim, inputs=[source(at, groups, named) for source in self._sources[key]])

    def _source(self, label: str, kind: Any, at: Any, groups: tuple[Any, ...], named: dict[str, Any]) -> _Source:
        name = label.removesuffix("_in").removesuffix("_out")
        if name in named:
            return lambda _at, _groups, named: named[name]
        if isinstance(kind, type(State)):
            return self._group(kind, at, groups)
        option = f"model.opt.{name.removeprefix('opt_')}"
        for path in (name, f"settings.{name}", f"tables.{name}", f"model.{name}", option):
            if _has(self._work, path):
                get = attrgetter(path)
                return lambda *_: get(self._work)
        for path in (name, f"data.{name}"):
            if _has(at, path):
                get = attrgetter(path)
                return lambda at, *_: get(at)
        raise AttributeError(f"no workspace, model or Data has the kernel's argument {label!r}")

    def _group(self, kind: Any, at: Any, groups: tuple[Any, ...]) -> _Source:
        for place, group in enumerate(groups):
            if group._cls is kind:
                return lambda _at, groups, _named: groups[place]
        work = self._work
        if name := _attribute_of_kind(work, kind):
            get = attrgetter(name)
            return lambda *_: get(work)
        if at is not None and (name := _attribute_of_kind(at, kind)):
            get = attrgetter(name)
            return lambda at, *_: get(at)
        holders = (work.tables, work.model, work.model.opt)
        if all(any(hasattr(holder, name) for holder in holders) for name in kind.vars):
            group = gather(kind, *holders)
            return lambda *_: group
        return lambda at, *_: gather(kind, *holders, at.data)
