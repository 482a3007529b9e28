"""A model's muscles, and the force of Hill-type muscles as torch functions, the same as MuJoCo's.

Axes: W worlds, U muscles.
"""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from msk_ray.errors import UnsupportedModelError


def muscles_of(model: mujoco.MjModel) -> np.ndarray:
    """Indices of the muscles among a model's actuators, (U,)."""
    return np.flatnonzero(model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_MUSCLE))


def smooth_activation(spec: mujoco.MjSpec, width: float) -> None:
    """Blend muscles' activation into deactivation over a width in excitation: a hard switch has no slope."""
    for actuator in spec.actuators:
        if actuator.dyntype == mujoco.mjtDyn.mjDYN_MUSCLE:
            actuator.dynprm[2] = width


class MuscleCurves:
    """Curves of a model's muscles, in actuator order.

    Attributes:
        actuators: indices of the muscles among the actuators, shape (U,).
        tendons: each muscle's tendon, to index with.
        peak: largest isometric force [N], shape (U,).
        optimum: optimal fibre length [m], shape (U,).

    Raises:
        UnsupportedModelError: a muscle is not driven through a tendon of gear 1.
    """

    def __init__(self, model: mujoco.MjModel, device: torch.device) -> None:
        found = muscles_of(model)
        through_tendon = model.actuator_trntype[found] == int(mujoco.mjtTrn.mjTRN_TENDON)
        if not np.all(through_tendon & (model.actuator_gear[found, 0] == 1.0)):
            raise UnsupportedModelError("muscles must pull on tendons with a gear of 1 to be observed")
        prm = model.actuator_gainprm[found]

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self.actuators = torch.tensor(found, device=device)
        self.tendons = columns(model.actuator_trnid[found, 0], device)
        ranges = model.actuator_lengthrange[found]
        optimum = (ranges[:, 1] - ranges[:, 0]) / (prm[:, 1] - prm[:, 0])
        # A negative force means scale / (acceleration per unit force) instead.
        peak = np.where(prm[:, 2] < 0, prm[:, 3] / model.actuator_acc0[found], prm[:, 2])
        self.peak = tensor(peak)
        self.optimum = tensor(optimum)
        self._offset = tensor(prm[:, 0] - ranges[:, 0] / optimum)
        self._lower, self._upper = tensor(prm[:, 4]), tensor(prm[:, 5])
        self._speed = tensor(optimum * prm[:, 6])
        self._passive, self._lengthening = tensor(model.actuator_biasprm[found, 7]), tensor(prm[:, 8])
        self._rise, self._fall = tensor(1.0 / (1.0 - prm[:, 4])), tensor(1.0 / (prm[:, 5] - 1.0))
        self._reach, self._bend = tensor(prm[:, 8] - 1.0), tensor(2.0 / (prm[:, 5] - 1.0))
        self._stiffness = self._passive * self._bend

    def normalised(self, length: Tensor, rate: Tensor) -> tuple[Tensor, Tensor]:
        """Fibre length [optimal lengths] and rate [largest shortening speeds] of paths (W, U) [m], [m/s]."""
        return self._offset + length / self.optimum, rate / self._speed

    def force(self, activation: Tensor, length: Tensor, rate: Tensor) -> Tensor:
        """Pull (W, U), in peak isometric forces, at normalised length and rate: a FL(l) FV(v) + FP(l)."""
        force: Tensor = _Force.apply(self, activation, length, rate)
        return force

    def length_curve(self, length: Tensor) -> Tensor:
        """Active force against length: parabolas from 0 to ½ to 1 and back, between `lower` and `upper`."""
        curve: Tensor = _Curve.apply(self.active, length)
        return curve

    def rate_curve(self, rate: Tensor) -> Tensor:
        """Active force against rate, 1 at rest, 0 at the largest shortening speed."""
        curve: Tensor = _Curve.apply(self.moving, rate)
        return curve

    def active(self, length: Tensor) -> tuple[Tensor, Tensor]:
        """`length_curve` and its slope.

        Both sides are the same curve of u, which rises from 0 at the end of the range to 1 at the optimum: 2u² up to
        u = ½, from there 1 - 2(1 - u)².
        """
        rising = (length - self._lower) * self._rise
        falling = (self._upper - length) * self._fall
        u = torch.minimum(rising, falling).clamp_min(0.0)
        near = torch.minimum(u, 1.0 - u)
        part = 2.0 * near.square()
        slope = near * torch.where(rising < falling, 4.0 * self._rise, -4.0 * self._fall)
        return torch.where(u <= 0.5, part, 1.0 - part), slope

    def moving(self, rate: Tensor) -> tuple[Tensor, Tensor]:
        """`rate_curve` and its slope: w² where the fibre shortens and L - (L - 1) w² where it lengthens, up to L."""
        w = torch.minimum(rate + 1.0, 1.0 - rate / self._reach).clamp_min(0.0)
        square = w.square()
        return torch.where(rate <= 0.0, square, self._lengthening - self._reach * square), 2.0 * w

    def passive(self, length: Tensor) -> tuple[Tensor, Tensor]:
        """Passive force against length, and its slope: a parabola half way to `upper`, and its tangent from there."""
        stretch = (length - 1.0).clamp_min(0.0) * self._bend
        bent = stretch.clamp_max(1.0)
        return self._passive * (stretch - 0.5 * bent) * bent, self._stiffness * bent


def columns(places: Any, device: torch.device) -> slice | Tensor:
    """What picks these columns of a tensor: a slice if they are evenly spaced, which takes no kernel and few back."""
    wanted = np.asarray(places, dtype=np.int64)
    steps = np.unique(np.diff(wanted))
    if wanted.size > 1 and steps.size == 1 and steps[0] > 0:
        return slice(int(wanted[0]), int(wanted[-1]) + 1, int(steps[0]))
    return torch.as_tensor(wanted, device=device)


class _Curve(torch.autograd.Function):
    """A curve whose slope is computed beside it: a third of the operations that autograd needs."""

    @staticmethod
    def forward(ctx: Any, curve: Callable[[Tensor], tuple[Tensor, Tensor]], x: Tensor) -> Tensor:
        value, slope = curve(x)
        ctx.save_for_backward(slope)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[None, Tensor]:
        (slope,) = ctx.saved_tensors
        return None, bar * slope


class _Force(torch.autograd.Function):
    """The whole force, with its slopes computed beside it."""

    @staticmethod
    def forward(ctx: Any, curves: MuscleCurves, activation: Tensor, length: Tensor, rate: Tensor) -> Tensor:
        active, steep = curves.active(length)
        moving, damping = curves.moving(rate)
        passive, stiff = curves.passive(length)
        gain = active * moving
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(gain, torch.addcmul(stiff, activation * moving, steep), activation * active * damping)
        return torch.addcmul(passive, activation, gain)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        return (None, *(bar * slope for slope in ctx.saved_tensors))
