"""Derivatives of an env step by float64 central differences of C MuJoCo.

Independent of what it checks: no Warp, no torch, no adjoint, only calls of `mj_step` with perturbed inputs.

Axes: R = 2 nv + na rows, the tangent of (qpos', qvel', act'); nu, nv, na as in MuJoCo.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from msk_ray.step.check.parameter_field import ParameterField
from msk_ray.step.errors import SimulationError

Array = NDArray[np.float64]

INPUTS = ("ctrl", "qpos", "qvel", "act")
"""What a step is differentiated with respect to besides parameters; qpos along tangent directions."""

FINE_STEP, COARSE_STEP = 1e-6, 1e-5
"""The two perturbations [each input's own unit].

The fine one is large enough for eight digits in float64. The coarse one is wide enough to reach across a kink that
float32 rounding of the state could cross.
"""

_COLUMN_STEPS, _COLUMN_SIDES = 1e-3, 1e-2
"""Disagreements above which the step counts as not differentiable by a parameter's element."""
_SMALL_COLUMN = 1e-3
"""Share of the largest column; smaller columns are compared with this share instead of their own size."""

_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


@dataclass(frozen=True)
class Point:
    """The inputs of one env step; also its results, with the same `ctrl`."""

    ctrl: Array
    """Controls, shape (nu,)."""
    qpos: Array
    """Generalised positions [m, rad, unit quaternions], shape (nq,)."""
    qvel: Array
    """Generalised velocities [m/s, rad/s], shape (nv,)."""
    act: Array
    """Actuator activations, shape (na,)."""


@dataclass(frozen=True)
class Linearization:
    """An env step's results and its derivatives there."""

    end: Point
    """Results of the step."""
    jacobian: Mapping[str, Array]
    """Derivative of the tangent of (qpos', qvel', act') by each input, shape (R, columns of the input)."""
    step_disagreement: Mapping[str, float]
    """By input, ‖J(fine) − J(coarse)‖ / ‖J(fine)‖.

    Up to 1e-4 where the step is smooth but sharply curved (impedances that change over a millimetre), which the
    extrapolation to zero perturbation removes; far above on a kink.
    """
    side_disagreement: Mapping[str, float]
    """By input, ‖J(forward) − J(backward)‖ / ‖J(fine)‖ of the fine one-sided differences.

    Of order FINE_STEP times the curvature where the step is smooth, of order one on a kink. It detects the kink on
    which the two central differences agree: one that passes through the state itself.
    """

    bent: Mapping[str, NDArray[np.bool_]]
    """By parameter, flags of the elements by which the step is not differentiable here, (columns of it,)."""

    def at_kink(self, step_limit: float, side_limit: float) -> bool:
        """Whether the step has a kink in its control or state within COARSE_STEP."""
        # Written so that a NaN counts as a kink.
        return not all(
            self.step_disagreement[name] <= step_limit and self.side_disagreement[name] <= side_limit
            for name in INPUTS
            if name in self.jacobian
        )

    def pull_back(self, cotangent: Array) -> dict[str, Array]:
        """Gradients of ⟨cotangent, (qpos', qvel', act')⟩ by input, for a tangent cotangent of shape (R,)."""
        return {name: block.T @ cotangent for name, block in self.jacobian.items()}


def reference_model(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model whose solver converges in float64, and whose step depends on (ctrl, qpos, qvel, act) only.

    The constraint problem is convex with one optimum, so the solver, its warm start and its iteration limits may be
    changed without changing the exact step.
    """
    reference = copy.copy(model)
    option = reference.opt
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.tolerance = 1e-15
    option.iterations = 200
    option.ls_tolerance = 1e-12
    option.ls_iterations = 200
    # A warm start would carry rounding from one evaluation to the next; an automatic reset would hide a divergence.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_WARMSTART | mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return reference


def _bent(fine: Array, steps: Array, sides: Array) -> NDArray[np.bool_]:
    """Columns of a parameter's derivative (R, columns) that depend on the size or the side of the difference."""
    size = np.linalg.norm(fine, axis=0)
    # A column that is small beside the largest one is rounding.
    scale = np.maximum(size, _SMALL_COLUMN * size.max(initial=0.0)) + np.finfo(float).tiny
    smooth = (np.linalg.norm(steps, axis=0) <= _COLUMN_STEPS * scale) & (
        np.linalg.norm(sides, axis=0) <= _COLUMN_SIDES * scale
    )
    return np.asarray(~smooth)


class Oracle:
    """Env steps of C MuJoCo in float64 and their derivatives.

    Args:
        model: the compiled model; it is not changed.
        substeps: calls of `mj_step` per env step, under one control.
        parameters: model fields to differentiate by, too. They are changed in place; fields that MuJoCo's compiler has
            computed from them stay fixed.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int, parameters: Sequence[str] = ()) -> None:
        self.model = reference_model(model)
        self.substeps = substeps
        self._fields = {name: ParameterField(self.model, name) for name in parameters}
        self._data = mujoco.MjData(self.model)

    @property
    def sizes(self) -> dict[str, int]:
        """Number of columns of each input."""
        inputs = {"ctrl": self.model.nu, "qpos": self.model.nv, "qvel": self.model.nv, "act": self.model.na}
        return inputs | {name: field.columns for name, field in self._fields.items()}

    def step(self, point: Point) -> Point:
        """One env step from `point`; a pure function.

        Raises:
            SimulationError: the state diverged.
        """
        data = self._data
        data.time = 0.0
        data.ctrl[:] = point.ctrl
        data.qpos[:] = point.qpos
        data.qvel[:] = point.qvel
        data.act[:] = point.act
        mujoco.mj_step(self.model, data, nstep=self.substeps)
        if any(data.warning[kind].number for kind in _DIVERGED):
            mujoco.mj_resetData(self.model, data)
            raise SimulationError(
                f"C MuJoCo diverged within {self.substeps} substeps: lower the model's timestep or use other states"
            )
        return Point(point.ctrl, data.qpos.copy(), data.qvel.copy(), data.act.copy())

    def touching(self, point: Point) -> bool:
        """Whether any contact at `point` carries a constraint."""
        data = self._data
        data.qpos[:] = point.qpos
        mujoco.mj_fwdPosition(self.model, data)
        return bool(np.any(data.contact.efc_address >= 0))

    def displaced(self, point: Point, name: str, column: int, amount: float) -> Point:
        """`point` with one input moved by `amount` along one coordinate; for qpos along a tangent direction."""
        fields = {key: getattr(point, key).copy() for key in INPUTS}
        if name == "qpos":
            direction = np.zeros(self.model.nv)
            direction[column] = 1.0
            mujoco.mj_integratePos(self.model, fields["qpos"], direction, amount)
        else:
            fields[name][column] += amount
        return Point(**fields)

    def difference(self, start: Point, end: Point) -> Array:
        """Tangent vector (R,) from `start` to `end`; its qpos rows are in the tangent space at `start`."""
        rotation = np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, rotation, 1.0, start.qpos, end.qpos)
        return np.concatenate((rotation, end.qvel - start.qvel, end.act - start.act))

    def linearize(self, point: Point) -> Linearization:
        """Results and full Jacobian of one env step, extrapolated from central differences with two step sizes.

        Costs 1 + 4·(nu + 2 nv + na + elements of parameters) env steps.

        Raises:
            SimulationError: this state or a perturbed one diverged.
        """
        end = self.step(point)
        jacobian: dict[str, Array] = {}
        steps: dict[str, float] = {}
        sides: dict[str, float] = {}
        bent: dict[str, NDArray[np.bool_]] = {}
        for name, columns in self.sizes.items():
            if columns == 0:
                continue
            forward, backward = self._one_sided(point, end, name, columns, FINE_STEP)
            fine = (forward + backward) / 2.0
            forward_coarse, backward_coarse = self._one_sided(point, end, name, columns, COARSE_STEP)
            coarse = (forward_coarse + backward_coarse) / 2.0
            scale = max(float(np.linalg.norm(fine)), np.finfo(float).tiny)
            # Richardson extrapolation cancels the error of central differences, which is quadratic in the step.
            ratio = (COARSE_STEP / FINE_STEP) ** 2
            jacobian[name] = fine + (fine - coarse) / (ratio - 1.0)
            steps[name] = float(np.linalg.norm(fine - coarse)) / scale
            sides[name] = float(np.linalg.norm(forward - backward)) / scale
            if name in self._fields:
                bent[name] = _bent(fine, fine - coarse, forward - backward)
        return Linearization(end, jacobian, steps, sides, bent)

    def _one_sided(self, point: Point, end: Point, name: str, columns: int, amount: float) -> tuple[Array, Array]:
        """Forward and backward difference quotients, each (R, columns)."""
        forward, backward = (
            np.stack([self._quotient(point, end, name, column, signed) for column in range(columns)], axis=1)
            for signed in (amount, -amount)
        )
        return forward, backward

    def _quotient(self, point: Point, end: Point, name: str, column: int, amount: float) -> Array:
        """Difference quotient (R,) along one coordinate of an input."""
        field = self._fields.get(name)
        if field is None:
            return self.difference(end, self.step(self.displaced(point, name, column, amount))) / amount
        amount *= field.scale(column)
        with field.displaced(column, amount):
            return self.difference(end, self.step(point)) / amount
