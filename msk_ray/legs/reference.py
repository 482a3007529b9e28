"""The motion of people as a reference: joint angles and rates by phase and speed, from measured means.

Hip flexion is measured against a pelvis whose plane is tilted forward by 9° in people who stand upright; a model's
pelvis is upright then, so that mean is subtracted. The zero of the measured ankle is a choice: here it is the one with
which the foot is level, on average, while it is flat on the ground (10 to 30 % of the cycle).
"""

import math
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from msk_ray.legs.clock import fourier, polynomial, series
from msk_ray.legs.costs import SWING
from msk_ray.legs.gait.body import JOINTS, SIDES, flexion_sign
from msk_ray.legs.gait.people import curve, pace_polynomials

MEASURED_AT = 1.25
"""Speed at which the measured angles are taken to hold [m/s]; hips swing in proportion to the step length."""
_FLAT = slice(10, 31)
_EXCHANGE = 0.06
"""Phase at which the weight has passed to the right foot [turns], the middle of people's double support."""
_RISE = (0.0112, 0.0232)
"""How far the centre of mass rises in a step [m] = first + second × speed [m/s]: 2.74 cm at 0.7 m/s and 4.83 cm at 1.6
m/s (Orendurff et al. 2004, J Rehabil Res Dev 41:829)."""
_GRAVITY = 9.81


def people_angles() -> np.ndarray:
    """Hip flexion, knee flexion and ankle dorsiflexion [rad] of a model with an upright pelvis, (3, 101)."""
    hip, knee, ankle = (curve(name).mean for name in JOINTS)
    hip = hip - curve("pelvis_tilt").mean.mean()
    pitch = hip - knee + ankle  # of the foot, toes up
    return np.deg2rad(np.stack((hip, knee, ankle - pitch[_FLAT].mean())))


def level_toes() -> np.ndarray:
    """Extension of the toes [rad] that keeps them level until the swing while their foot is pitched down, (101,)."""
    hip, knee, ankle = people_angles()
    on_ground = np.arange(101) < 100 * SWING[0]
    return np.where(on_ground, np.clip(knee - hip - ankle, 0.0, None), 0.0)


def sway(half_width: float, height: float) -> np.ndarray:
    """How far the pelvis is to the right of its line [m] from the right foot's strike on, (101,), at `MEASURED_AT`.

    That of a linear inverted pendulum which comes to each foot with the speed that brings it back to the line when the
    feet are exchanged (Hof 2008, doi:10.1016/j.humov.2007.08.003). Without that speed it falls away from the foot.

    Args:
        half_width: distance of each foot from the line [m].
        height: of the pendulum [m].
    """
    step = 60.0 / float(np.polyval(pace_polynomials()[0], MEASURED_AT))
    time = math.sqrt(height / _GRAVITY)
    since = np.remainder(2.0 * (np.arange(101) / 100.0 - _EXCHANGE), 2.0)  # steps
    over = 1.0 - np.cosh((since % 1.0 - 0.5) * step / time) / math.cosh(0.5 * step / time)
    return half_width * np.where(since < 1.0, over, -over)


def adduction_under(model: mujoco.MjModel, data: mujoco.MjData, side: str, aside: float, left: np.ndarray) -> float:
    """Change of hip adduction [rad] that brings a foot back to its line when the pelvis has moved to the right.

    Args:
        model: of legs.
        data: their pose, with `mj_comPos` done.
        side: r or l.
        aside: how far the pelvis has moved [m].
        left: direction in the world, (3,).
    """
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacBody(model, data, jacobian, None, model.body(f"calcn_{side}").id)
    return aside / float(left @ jacobian[:, model.joint(f"hip_adduction_{side}").dofadr[0]])


class Reference:
    """Angles of hip, knee and ankle of both legs in a model.

    Attributes:
        joints: their ids, right leg first, (6,).
        coefficients: of the curves of the right leg, in the model's signs, (3, 2, K).
    """

    def __init__(self, model: mujoco.MjModel, device: torch.device) -> None:
        self.joints = [model.joint(f"{joint}_{side}").id for side in SIDES for joint in JOINTS.values()]
        signs = np.array([flexion_sign(model, joint) for joint in JOINTS.values()])
        curves = signs[:, None] * people_angles()
        self.coefficients = torch.tensor(np.stack([fourier(c) for c in curves]), dtype=torch.float32, device=device)
        cadence, step = (torch.tensor(c, dtype=torch.float32, device=device) for c in pace_polynomials())
        self.pace = Pace(cadence, step)
        self._step_here = float(np.polyval(pace_polynomials()[1], MEASURED_AT))

    def __call__(self, phase: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Angles [rad] and rates [rad/s], each (W, 6), at the right leg's phases (W,) [turns] and speeds (W,) [m/s]."""
        both = torch.stack((phase, phase + 0.5), dim=-1)
        angle, slope = series(self.coefficients.to(phase.dtype), both)
        swing = (self.pace.step_length(speed) / self._step_here)[:, None]
        mean = self.coefficients[0, 0, 0]
        hip, hip_slope = mean + swing * (angle[..., 0] - mean), swing * slope[..., 0]
        angle = torch.cat((hip[..., None], angle[..., 1:]), dim=-1)
        slope = torch.cat((hip_slope[..., None], slope[..., 1:]), dim=-1)
        rate = slope * self.pace.strides_per_second(speed)[:, None, None]
        return angle.flatten(1), rate.flatten(1)


class Pace(NamedTuple):
    """Cadence and step length of people as polynomials of the speed [m/s]."""

    cadence_polynomial: Tensor
    step_polynomial: Tensor

    def strides_per_second(self, speed: Tensor) -> Tensor:
        """Gait cycles per second [1/s], (W,)."""
        return polynomial(self.cadence_polynomial, speed) / 120.0

    def step_length(self, speed: Tensor) -> Tensor:
        """Step length [m], (W,)."""
        return polynomial(self.step_polynomial, speed)

    def vault(self, phase: Tensor, speed: Tensor) -> Tensor:
        """Vertical velocity [m/s], (W,), of a centre of mass that rises and sinks as a sine at phases (W,) [turns]."""
        rise = _RISE[0] + _RISE[1] * speed
        turn = 2.0 * math.tau * self.strides_per_second(speed)  # once a step [rad/s]
        return 0.5 * rise * turn * torch.sin(2.0 * math.tau * (phase - _EXCHANGE)).to(speed.dtype)

    def hip_swing(self, speed: Tensor, leg: float) -> Tensor:
        """Largest angle between both hips [rad], (W,), of legs of this length [m] that take such steps."""
        return 2.0 * torch.asin((self.step_length(speed) / (2.0 * leg)).clamp(0.0, math.sin(1.0)))
