"""Refuses edits of a model that recorded graphs would follow only in part."""

import ctypes
import dataclasses
import operator
from typing import Any, NoReturn

import mujoco
import numpy as np

from msk_ray.step.errors import ConfigError

_SMALL = 1 << 16
"""Arrays up to this size are compared at every call [B]: everything but meshes, height fields and textures."""
_LARGE = ("mesh_vert", "hfield_data")
"""Larger arrays that physics reads, compared only in thorough checks."""
_memcmp = ctypes.CDLL(None).memcmp
_memcmp.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)


def seal(holder: Any, path: str) -> None:
    """Make attributes of `holder`, a dataclass, and of the dataclasses in it read-only from now on.

    Its arrays can still change in place, because recorded graphs read their memory.
    """

    def refuse(_: Any, name: str, *__: Any) -> NoReturn:
        raise ConfigError(
            f"{path}.{name} cannot be replaced, because recorded steps read the old one; change the MjModel before "
            "making the Simulation, or give its step new values as parameters={...}"
        )

    for field in dataclasses.fields(holder):
        value = getattr(holder, field.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            seal(value, f"{path}.{field.name}")
    kind = type(holder)
    holder.__class__ = type(kind.__name__, (kind,), {"__setattr__": refuse, "__delattr__": refuse})


class ModelWatch:
    """Checks whether an MjModel has been edited.

    The model's small arrays are in a few ranges of one buffer, and its options in one struct; both are compared byte by
    byte with a copy. Memory between the two belongs to others.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        own = _arrays_of(model)
        options = {f"opt.{name}": value for name, value in _arrays_of(model.opt).items()}
        self._options = [n for n in dir(model.opt) if isinstance(getattr(model.opt, n), (int, float))]
        self._read_options = operator.attrgetter(*self._options)
        self._scalars = self._read_options(model.opt)
        self._arrays = {
            name: (value, value.copy())
            for name, value in (own | options).items()
            if value.nbytes and (value.nbytes <= _SMALL or name in _LARGE)
        }
        self._stretches = [
            (first, ctypes.string_at(first, size), size)
            for arrays in (own, options)
            for first, size in _stretches([a for a in arrays.values() if 0 < a.nbytes <= _SMALL])
        ]

    def check(self, thorough: bool = False) -> None:
        """Raise if the model was edited.

        Args:
            thorough: compare meshes and height fields too.

        Raises:
            ConfigError: the model was edited; the message names the fields.
        """
        same = all(_memcmp(first, copy, size) == 0 for first, copy, size in self._stretches)
        if same and self._read_options(self._model.opt) == self._scalars:
            if not thorough:
                return
            if all(np.array_equal(now, then) for now, then in self._arrays.values() if now.nbytes > _SMALL):
                return
        raise ConfigError(
            f"the MjModel was edited after its Simulation was made ({', '.join(self._edited())}), which recorded steps "
            "do not follow: make another Simulation of the edited model, and edit a copy (copy.copy(model)) if this "
            "one is to go on"
        )

    def _edited(self) -> list[str]:
        options = zip(self._options, self._read_options(self._model.opt), self._scalars, strict=True)
        edited = [f"opt.{name}" for name, now, then in options if now != then]
        return edited + [name for name, (a, then) in self._arrays.items() if a.tobytes() != then.tobytes()]


def _arrays_of(holder: Any) -> dict[str, np.ndarray]:
    """Attributes of `holder` that are views of its memory; others are computed on access."""
    arrays = {name: value for name in dir(holder) if isinstance(value := getattr(holder, name), np.ndarray)}
    return {name: value for name, value in arrays.items() if not value.flags.owndata}


def _stretches(arrays: list[np.ndarray]) -> list[tuple[int, int]]:
    """(address, bytes) of the memory ranges filled by arrays of one allocation, with gaps for alignment."""
    merged: list[tuple[int, int]] = []
    for first, end in sorted((a.ctypes.data, a.ctypes.data + a.nbytes) for a in arrays):
        if merged and first - merged[-1][1] < 64:
            merged[-1] = (merged[-1][0], max(end, merged[-1][1]))
        else:
            merged.append((first, end))
    return [(first, end - first) for first, end in merged]
