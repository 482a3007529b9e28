"""Metabolic power of muscles by the model of Bhargava, Pandy & Anderson (2004), J Biomech 37:81-88.

Axes: W worlds, U muscles. Muscles are taken to be half slow and half fast fibres, and stimulated for so long that the
decay of the activation heat is over.
"""

import math
from typing import Final, NamedTuple

import torch
from torch import Tensor

from msk_ray.legs.muscles import MuscleCurves

ACTIVATION: Final = (40.0, 133.0)
"""Activation heat of slow and fast fibres [W/kg] (their table 1)."""
MAINTENANCE: Final = (74.0, 111.0)
"""Maintenance heat of slow and fast fibres [W/kg]."""
SLOW: Final = 0.5
"""Share of slow fibres."""
SHORTENING: Final = (0.16, 0.18)
"""Shortening heat per metre, as shares of the isometric and of the actual force."""
LENGTHENING: Final = 0.157
"""Heat of a muscle that is stretched per metre, as a share of its force."""
BASAL: Final = 1.2
"""Power of the body at rest [W/kg]."""
DENSITY: Final = 1059.7
"""Of muscle [kg/m³]."""
SPECIFIC_TENSION: Final = 0.25e6
"""Largest isometric force per cross-section [N/m²]; with `DENSITY`, it gives the mass of a muscle."""


class Fibres(NamedTuple):
    """What muscles do, each (W, U)."""

    excitation: Tensor
    activation: Tensor
    length: Tensor
    """[optimal lengths]."""
    rate: Tensor
    """[m/s], negative where they shorten."""
    force: Tensor
    """Active force [N]."""
    isometric: Tensor
    """Active force at the same activation and length, but at rest [N]."""


def muscle_masses(peak: Tensor, optimum: Tensor) -> Tensor:
    """Masses [kg], (U,), of muscles with a largest isometric force `peak` [N] and an optimal length [m]."""
    return DENSITY * optimum * peak / SPECIFIC_TENSION


def power(fibres: Fibres, masses: Tensor) -> Tensor:
    """Metabolic power of each muscle [W], (W, U): heat and mechanical work.

    The heat of a muscle is at least 1 W/kg, as in the model's implementation in OpenSim; work on a stretched muscle
    counts as negative.
    """
    quarter = math.pi / 2.0
    slow, fast = SLOW, 1.0 - SLOW

    def mixed(rates: tuple[float, float], drive: Tensor) -> Tensor:
        return rates[0] * slow * torch.sin(quarter * drive) + rates[1] * fast * (1.0 - torch.cos(quarter * drive))

    activation = masses * mixed(ACTIVATION, fibres.excitation)
    maintenance = masses * _length_dependence(fibres.length) * mixed(MAINTENANCE, fibres.activation)
    shortening = SHORTENING[0] * fibres.isometric + SHORTENING[1] * fibres.force
    heat_per_metre = torch.where(fibres.rate <= 0.0, shortening, LENGTHENING * fibres.force)
    # −α v: shortening gives off heat, stretching takes it up.
    heat = activation + maintenance - heat_per_metre * fibres.rate
    return torch.maximum(heat, masses) - fibres.force * fibres.rate


def total_power(
    curves: MuscleCurves, masses: Tensor, excitation: Tensor, activation: Tensor, length: Tensor, rate: Tensor
) -> Tensor:
    """Metabolic power of all muscles [W], (W,).

    Args:
        curves: of the model's muscles.
        masses: of the muscles [kg], (U,).
        excitation, activation: of the muscles, (W, U).
        length, rate: of all the model's tendons [m], [m/s], (W, ntendon).
    """
    rate = rate[:, curves.tendons]
    length, relative = curves.normalised(length[:, curves.tendons], rate)
    isometric = activation * curves.length_curve(length) * curves.peak
    force = isometric * curves.rate_curve(relative)
    return power(Fibres(excitation, activation, length, rate, force, isometric), masses).sum(-1)


def _length_dependence(length: Tensor) -> Tensor:
    """Share of the maintenance heat at a length: ½ up to 0.5, 1 at 1, 0 from 1.5, linear between."""
    return torch.where(length <= 1.0, length.clamp_min(0.5), 3.0 - 2.0 * length).clamp(0.0, 1.0)
