"""Launches of kernels whose arguments are found by their names and types, as `gather` finds the fields of a group.

What the caller names, or a group that it gives, counts before anything else: that is how a kernel gets `lam` alone, or
`bars` of one law. All else must have one source: where two holders have an argument's name, or a group's type, with
different objects, the first launch raises, so that a new attribute never takes an argument away from another holder.

Example: `damping_in` of `sweep_up` is `work.damping`, the coefficients (c₀, c₁, c₂) of each dof, because nothing else
has that name; the model's own are `dof_damping` and `tendon_damping`, and the diagonal hB is named in its launch.
"""

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any

import warp as wp

from msk_ray.step.adjoint.groups import State, gather

_Source = Callable[[Any, tuple[Any, ...], dict[str, Any]], Any]
"""Gives an argument from the substep, the caller's groups and what the caller names."""


def _only(what: str, places: Mapping[str, Any]) -> str | None:
    """The first of the places that have what a kernel takes, which must all have one object; None if there is none.

    Raises:
        ValueError: they have different objects.
    """
    if len({id(value) for value in places.values()}) > 1:
        raise ValueError(f"{what} may be {' or '.join(places)}: rename one of them, or give the argument in the launch")
    return next(iter(places), None)


def _named(name: str, holders: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{path}.{name}": getattr(holder, name) for path, holder in holders.items() if hasattr(holder, name)}


def _of_kind(kind: Any, holders: Mapping[str, Any]) -> dict[str, Any]:
    return {
        f"{path}.{name}": value
        for path, holder in holders.items()
        for name, value in vars(holder).items()
        if getattr(value, "_cls", None) is kind
    }


class Launcher:
    """Launches kernels of one model's adjoint.

    An array or number called `x`, `x_in`, `x_out` or `opt_x` is what the caller names x, else the attribute x of the
    workspace, its settings, its tables, the model, its options, the substep or its Data. A group is the one of its type
    that the caller, the workspace or the substep has; else its fields are found one by one in the tables, the model,
    its options and the Data.

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
            ValueError: several have it, with different objects. Checked when a kernel is first launched.
        """
        key = (kernel, *(group._cls for group in groups), *named)
        if key not in self._sources:
            self._sources[key] = [self._source(kernel, arg, at, groups, named) for arg in kernel.adj.args]
        wp.launch(kernel, dim=dim, inputs=[source(at, groups, named) for source in self._sources[key]])

    def _source(self, kernel: Any, arg: Any, at: Any, groups: tuple[Any, ...], named: dict[str, Any]) -> _Source:
        name = arg.label.removesuffix("_in").removesuffix("_out")
        if name in named:
            return lambda _at, _groups, named: named[name]
        what = f"the argument {arg.label!r} of the kernel {kernel.key}"
        if isinstance(arg.type, type(State)):
            return self._group(what, arg.type, at, groups)
        work, option = self._work, name.removeprefix("opt_")
        holders = {"work": work, "work.settings": work.settings, "work.tables": work.tables, "work.model": work.model}
        places = _named(name, holders) | _named(option, {"work.model.opt": work.model.opt})
        if at is not None:
            places |= _named(name, {"at": at, "at.data": at.data})
        place = _only(what, places)
        if place is None:
            raise AttributeError(f"no workspace, model or Data has {what}")
        return self._attribute(place)

    def _attribute(self, place: str) -> _Source:
        """What is at a path that begins with `work` or `at`."""
        holder, _, path = place.partition(".")
        get, work = attrgetter(path), self._work
        if holder == "work":
            return lambda *_: get(work)
        return lambda at, *_: get(at)

    def _group(self, what: str, kind: Any, at: Any, groups: tuple[Any, ...]) -> _Source:
        given = {str(number): group for number, group in enumerate(groups) if group._cls is kind}
        if (number := _only(f"{what}, among the groups of the launch,", given)) is not None:
            return lambda _at, groups, _named: groups[int(number)]
        work = self._work
        if place := _only(what, _of_kind(kind, {"work": work} if at is None else {"work": work, "at": at})):
            return self._attribute(place)
        holders = {"work.tables": work.tables, "work.model": work.model, "work.model.opt": work.model.opt}
        every = holders if at is None else holders | {"at.data": at.data}
        for name in kind.vars:
            _only(f"the field {name!r} of {what}", _named(name, every))
        if all(_named(name, holders) for name in kind.vars):
            group = gather(kind, *holders.values())
            return lambda *_: group
        return lambda at, *_: gather(kind, *holders.values(), at.data)
