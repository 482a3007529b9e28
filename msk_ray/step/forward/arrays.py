"""Groups of arrays that kernels take as one argument: gathered from other structures, or allocated. And a sum."""

from collections.abc import Mapping
from typing import Any

import warp as wp


@wp.kernel(enable_backward=False)
def add_into(
    # In:
    x_in: wp.array2d[float],
    # Out:
    y_out: wp.array2d[float],
) -> None:
    """y += x."""
    i, j = wp.tid()
    y_out[i, j] = y_out[i, j] + x_in[i, j]


def gather(kind: Any, *holders: Any) -> Any:
    """A group filled with the arrays that `holders` have under its fields' names; the first holder that has one counts.

    Raises:
        AttributeError: no holder has an array of that name.
        TypeError: an array has another dtype or number of axes.
    """
    group = kind()
    for name in kind.vars:
        holder = next((h for h in holders if hasattr(h, name)), holders[-1])
        setattr(group, name, getattr(holder, name))
    return group


def allocate(kind: Any, *shape: int) -> Any:
    """A group whose fields are arrays of zeros on the current device."""
    group = kind()
    for name, field in kind.vars.items():
        setattr(group, name, wp.zeros(shape, dtype=field.type.dtype))
    return group


def empty(kind: Any) -> Any:
    """A group whose arrays have no size, on the current device."""
    group = kind()
    for name, field in kind.vars.items():
        setattr(group, name, wp.zeros((0,) * field.type.ndim, dtype=field.type.dtype))
    return group


def allocate_rows(kind: Any, worlds: int, widths: Mapping[str, int], width: int) -> Any:
    """The same for arrays (worlds, width); `widths` gives other widths by field."""
    group = kind()
    for name, field in kind.vars.items():
        setattr(group, name, wp.zeros((worlds, widths.get(name, width)), dtype=field.type.dtype))
    return group
