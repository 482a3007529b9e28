"""Costs of a walk, as pure functions. W worlds, U muscles, F points of the feet."""

import torch
from torch import Tensor

from msk_ray.legs.clock import window

HEEL_DOWN = (0.02, 0.40)
"""Phases of the own leg between which the heel stands on the ground [turns], with flanks inside. These and the next two
are those at which the feet of `people_angles` move by less than 0.3 m/s, or are 1 cm above the ground."""
TOES_DOWN = (0.10, 0.60)
"""The same of the toes."""
SWING = (0.64, 0.92)
"""The same of the swing."""
LANDED = (-0.04, 0.12)
"""Phases of the own leg, with flanks inside, at which the heel should have landed; people's strike is at 0. It opens
earlier because the toes of these legs leave the ground up to 5 % of the cycle before people's, and a stance as long as
theirs has to begin earlier, too."""
_HOVERING = 0.002
"""Height of a heel that should have landed beyond which its cost grows linearly [m]."""
_SLIDING = 0.3
"""Speed of a foot that should stand beyond which its cost grows linearly [m/s]."""
_BENT = 0.15
"""Angle of the toes beyond which its cost grows linearly [rad]."""
_VAULTING = 0.1
"""Error of the pelvis's vertical velocity beyond which its cost grows linearly [m/s]."""
_TURNED = 0.15
"""Angle out of the plane of walking beyond which its cost grows linearly [rad]."""
_NEAR = 0.03
"""Height above the ground at which an approaching foot counts 1/e [m]."""


def soft(squares: Tensor) -> Tensor:
    """√(1 + x²) − 1 of squares x²: half of it while small, then |x|."""
    return torch.sqrt(1.0 + squares) - 1.0


def sliding(phase: Tensor, heel: Tensor, toes: Tensor) -> Tensor:
    """Cost (W,) of a foot that moves while it should stand.

    Args:
        phase: of its leg [turns], (W,).
        heel, toes: their velocities [m/s], (W, 3).
    """
    down = window(phase, *HEEL_DOWN), window(phase, *TOES_DOWN)
    speeds = ((velocity / _SLIDING).square().sum(-1) for velocity in (heel, toes))
    return sum((on * soft(speed) for on, speed in zip(down, speeds, strict=True)), torch.zeros_like(phase))


def hovering(phase: Tensor, heel: Tensor) -> Tensor:
    """Cost (W,) of a heel that is above the ground when it should have landed.

    Args:
        phase: of its leg [turns], (W,).
        heel: its height above its place in standing [m], (W,).
    """
    return window(phase, *LANDED) * soft((torch.relu(heel) / _HOVERING).square())


def dragging(phase: Tensor, heights: Tensor, clearance: float) -> Tensor:
    """Cost (W,) of a foot that is too low in its swing: the mean of (missing height / clearance)².

    Args:
        phase: of its leg [turns], (W,).
        heights: of heel and toes above their place in standing [m], (W, 2).
        clearance: height that is asked for [m].
    """
    missing = torch.relu(clearance - heights) / clearance
    return window(phase, *SWING) * missing.square().mean(-1)


def lifted_toes(phase: Tensor, slope: Tensor, bend: Tensor) -> Tensor:
    """Cost (W,) of a foot's toes that are not level while on the ground, or bent against their foot in the air.

    Args:
        phase: of its leg [turns], (W,).
        slope: sine of the toes' angle to the ground, (W,).
        bend: 2 (1 - cos) of their angle to the foot, which is the angle squared while small, (W,).
    """
    down = window(phase, *TOES_DOWN)
    return soft((down * slope.square() + (1.0 - down) * bend) / _BENT**2)


def impact(heights: Tensor, fall: Tensor) -> Tensor:
    """Cost (W,) of points of the feet that come down [m²/s²]: Σ v² e^(-h/3 cm) over those moving down.

    Args:
        heights: above the ground [m], (W, F).
        fall: upward velocities [m/s], (W, F).
    """
    return (torch.relu(-fall).square() * torch.exp(-heights.clamp_min(0.0) / _NEAR)).sum(-1)


def vaulting(velocity: Tensor, wanted: Tensor) -> Tensor:
    """Cost (W,) of vertical velocities (W,) [m/s] of the pelvis apart from those of a vaulting body."""
    return soft(((velocity - wanted) / _VAULTING).square())


def out_of_plane(angles: Tensor) -> Tensor:
    """Cost (W,) of angles (W, n) [rad] of joints that turn legs out of the plane they walk in."""
    return soft((angles / _TURNED).square().mean(-1))


def deviation(values: Tensor, reference: Tensor, scale: float) -> Tensor:
    """Cost (W,) of values (W, n) apart from a reference: √(1 + mean ((x - r)/scale)²) - 1."""
    return soft(((values - reference) / scale).square().mean(-1))


def stride_error(angles: Tensor, rates: Tensor, amplitude: float | Tensor, rate: float | Tensor) -> Tensor:
    """(r - 1)², shape (W,), of the angle d between both hips as a pendulum: r² = (d/A)² + (d'/(Aω))².

    Args:
        angles: right and left hip flexion [rad], (W, 2).
        rates: their velocities [rad/s], (W, 2).
        amplitude: A [rad], of all worlds or (W, 1).
        rate: ω [rad/s], of all worlds or (W,).
    """
    (right, left), (right_rate, left_rate) = angles.unbind(-1), rates.unbind(-1)
    swing = torch.stack((right - left, (right_rate - left_rate) / rate), dim=-1) / amplitude
    # The square root has no slope where the legs stand still together.
    radius = torch.sqrt(swing.square().sum(-1) + 1e-4)
    return (radius - 1.0).square()
