"""Force of Hill-type muscles as torch functions, the same as MuJoCo's.

Axes: W worlds, U muscles.
"""

import mujoco
import numpy as np
import torch
from torch import Tensor

from msk_ray.errors import UnsupportedModelError


class MuscleCurves:
    """Curves of a model's muscles, in actuator order.

    Attributes:
        actuators: indices of the muscles among the actuators, shape (U,).
        tendons: index of each muscle's tendon, shape (U,).
        peak: largest isometric force [N], shape (U,).
        optimum: optimal fibre length [m], shape (U,).

    Raises:
        UnsupportedModelError: a muscle is not driven through a tendon of gear 1.
    """

    def __init__(self, model: mujoco.MjModel, device: torch.device) -> None:
        found = np.flatnonzero(model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_MUSCLE))
        through_tendon = model.actuator_trntype[found] == int(mujoco.mjtTrn.mjTRN_TENDON)
        if not np.all(through_tendon & (model.actuator_gear[found, 0] == 1.0)):
            raise UnsupportedModelError("muscles must pull on tendons with a gear of 1 to be observed")
        prm = model.actuator_gainprm[found]

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self.actuators = torch.tensor(found, device=device)
        self.tendons = torch.tensor(model.actuator_trnid[found, 0].astype(np.int64), device=device)
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

    def normalised(self, length: Tensor, rate: Tensor) -> tuple[Tensor, Tensor]:
        """Fibre length [optimal lengths] and rate [largest shortening speeds] of paths (W, U) [m], [m/s]."""
        return self._offset + length / self.optimum, rate / self._speed

    def force(self, activation: Tensor, length: Tensor, rate: Tensor) -> Tensor:
        """Pull (W, U), in peak isometric forces, at normalised length and rate: a FL(l) FV(v) + FP(l)."""
        return activation * self.length_curve(length) * self.rate_curve(rate) + self.passive_curve(length)

    def length_curve(self, length: Tensor) -> Tensor:
        """Active force against length: parabolas from 0 to ½ to 1 and back, between `lower` and `upper`."""
        rising = (self._lower + 1.0) / 2.0
        falling = (self._upper + 1.0) / 2.0
        outside = (length < self._lower) | (length > self._upper)
        start = (length - self._lower) / (rising - self._lower)
        below = (1.0 - length) / (1.0 - rising)
        above = (length - 1.0) / (falling - 1.0)
        end = (self._upper - length) / (self._upper - falling)
        half = 0.5
        curve = torch.where(length <= rising, half * start.square(), 1.0 - half * below.square())
        beyond = torch.where(length <= falling, 1.0 - half * above.square(), half * end.square())
        return torch.where(length <= 1.0, curve, beyond).masked_fill(outside, 0.0)

    def rate_curve(self, rate: Tensor) -> Tensor:
        """Active force against rate, 1 at rest, 0 at the largest shortening speed."""
        reach = self._lengthening - 1.0
        stretching = self._lengthening - (reach - rate.clamp_max(reach)).square() / reach
        return torch.where(rate <= 0.0, (rate.clamp_min(-1.0) + 1.0).square(), stretching)

    def passive_curve(self, length: Tensor) -> Tensor:
        """Passive force against length."""
        bend = (self._upper - 1.0) / 2.0
        stretch = (length - 1.0).clamp_min(0.0) / bend
        return self._passive * torch.where(stretch <= 1.0, 0.5 * stretch.square(), stretch - 0.5)
