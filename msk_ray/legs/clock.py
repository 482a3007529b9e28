"""The clock of a walk: the phase of the right leg's gait cycle, in turns from its foot strike.

Axes: W worlds. The left leg is half a turn behind. Cadence follows the speed as in people.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

HARMONICS = 8
"""Of the series that stand for measured curves; the largest error is below 1.5°."""


def polynomial(coefficients: Tensor, x: Tensor) -> Tensor:
    """Value (W,) at x (W,) of a polynomial with these coefficients, highest power first."""
    value = torch.zeros_like(x)
    for coefficient in coefficients:
        value = value * x + coefficient
    return value


def fourier(curve: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients (2, HARMONICS + 1) of cos and sin of a periodic curve (101,) whose ends are one point."""
    values = curve[:-1].copy()
    values[0] = (curve[0] + curve[-1]) / 2.0
    spectrum = np.fft.rfft(values)[: HARMONICS + 1] / len(values)
    spectrum[1:] *= 2.0
    return np.stack((spectrum.real, -spectrum.imag))


def series(coefficients: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
    """Values and slopes per turn, each (..., C), of C curves with coefficients (C, 2, K) at phases (...) [turns]."""
    order = torch.arange(coefficients.shape[-1], device=phase.device, dtype=phase.dtype)
    angle = math.tau * phase[..., None] * order
    cos, sin = torch.cos(angle)[..., None, :], torch.sin(angle)[..., None, :]
    a, b = coefficients[:, 0], coefficients[:, 1]
    value = (a * cos + b * sin).sum(-1)
    slope = (math.tau * order * (b * cos - a * sin)).sum(-1)
    return value, slope


def window(phase: Tensor, start: float, end: float, edge: float = 0.04) -> Tensor:
    """1 while a phase [turns] is between `start` and `end`, 0 else, with cosine flanks `edge` wide inside."""
    since = torch.remainder(phase - start, 1.0)
    width = end - start
    rise = (since / edge).clamp(0.0, 1.0)
    fall = ((width - since) / edge).clamp(0.0, 1.0)
    return 0.25 * (1.0 - torch.cos(math.pi * rise)) * (1.0 - torch.cos(math.pi * fall))
