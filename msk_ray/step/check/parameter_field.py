"""A parameter of C MuJoCo's model, displaced element by element for finite differences."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from operator import attrgetter

import mujoco
import numpy as np
from numpy.typing import NDArray

from msk_ray.step.forward.parameters import PARAMETERS

_INERTIAL = ("body_mass", "body_inertia", "dof_armature")
_TYPICAL = 0.1
"""A perturbation is proportional to the element, but at least to this share of the largest element in its place."""

_ABSENT = 100.0
"""Scale of a spring, damper or friction loss that is zero in the whole model: 1e-6 would vanish in a step's rounding,
and below what C MuJoCo's solver resolves."""


class ParameterField:
    """One parameter of a model. Each element is a column; a quaternion has three, its rotations in the local frame.

    Disables C MuJoCo's shortcuts for frames that coincide with their body's.
    """

    def __init__(self, model: mujoco.MjModel, name: str) -> None:
        self._model = model
        self._quaternion = PARAMETERS[name].quaternion
        self._scalar = not np.ndim(attrgetter(name)(model))
        self._name = name
        values = np.atleast_1d(attrgetter(name)(model))
        self._values = values.reshape(-1, values.shape[-1]) if values.ndim > 1 else values[:, None]
        if name == "opt.gravity":
            self._values = values[None, :]
        largest = np.abs(self._values).max(axis=0, initial=0.0)
        unset = 1.0 if PARAMETERS[name].in_use is None else _ABSENT
        self._scale = np.maximum(np.abs(self._values), np.where(largest > 0.0, _TYPICAL * largest, unset))
        for shortcut in (model.body_sameframe, model.geom_sameframe, model.site_sameframe):
            shortcut[:] = 0

    @property
    def columns(self) -> int:
        """Number of columns."""
        rows, width = self._values.shape
        return rows * (3 if self._quaternion else width)

    def scale(self, column: int) -> float:
        """Scale of an element, to which its perturbation is proportional."""
        return 1.0 if self._quaternion else float(self._scale.flat[column])

    @contextmanager
    def displaced(self, column: int, amount: float) -> Iterator[None]:
        """Context with one element of the model moved by `amount`."""
        row, part = divmod(column, 3 if self._quaternion else self._values.shape[1])
        before: NDArray[np.float64] = self._values[row].copy()
        moved = before.copy()
        if self._quaternion:
            turn = np.zeros(3)
            turn[part] = 1.0
            mujoco.mju_quatIntegrate(moved, turn, amount)
        else:
            moved[part] += amount
        try:
            self._write(row, moved)
            yield
        finally:
            self._write(row, before)

    def _write(self, row: int, values: NDArray[np.float64]) -> None:
        model = self._model
        if self._scalar:
            setattr(model.opt, self._name.rpartition(".")[2], float(values[0]))
            return
        self._values[row] = values
        if self._name in _INERTIAL and np.any(model.dof_simplenum):
            # MuJoCo stores the inertia of such dofs instead of computing it.
            fresh = copy.copy(model)
            mujoco.mj_setConst(fresh, mujoco.MjData(fresh))
            model.dof_M0[:] = fresh.dof_M0
