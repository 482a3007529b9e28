"""Jacobians of an env step, (A, B) in tangent space, from pullbacks of one cotangent per row.

Axes: W worlds, S = 2 nv + na entries of a state (position in tangent space, velocity, activation), R of its rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from msk_ray.step.autograd.tangent import Tangent

if TYPE_CHECKING:
    from msk_ray.step.autograd.backward import InputGradients, StepState


class Linearization(NamedTuple):
    """x' = end + A δx + B δu to first order around a state and control; ordered as in MuJoCo's mjd_transitionFD."""

    A: Tensor
    """∂(state after) / ∂(state before), shape (W, S, S)."""
    B: Tensor
    """∂(state after) / ∂ctrl, shape (W, S, nu)."""
    end: StepState
    """The state after the env step."""


def state_size(end: StepState) -> int:
    """S, the size of a state in tangent space."""
    return 2 * end.qvel.shape[-1] + end.act.shape[-1]


def unit_cotangents(tangent: Tangent, end: StepState, rows: range, count: int) -> StepState:
    """Cotangents, in raw coordinates at `end`, that each select one entry of the state after a step.

    Args:
        tangent: the joints of the model.
        end: the state after the step.
        rows: the entries.
        count: R, at least the number of rows; further cotangents are zero.

    Returns:
        Cotangents of shapes (R, W, nq), (R, W, nv) and (R, W, na).
    """
    shape, nv, na = (count, len(end.qpos), -1), tangent.nv, end.act.shape[-1]
    unit = torch.zeros(count, 2 * nv + na, device=end.qpos.device)
    unit[range(len(rows)), rows] = 1.0
    qpos, qvel, act = (part[:, None].expand(shape) for part in unit.split([nv, nv, na], dim=-1))
    return end._replace(qpos=tangent.lift(end.qpos.expand(shape), qpos), qvel=qvel, act=act)


def rows_of(tangent: Tangent, start: StepState, gradients: InputGradients) -> tuple[Tensor, Tensor]:
    """Rows of A and B, (..., W, S) and (..., W, nu), from gradients of the same leading shape at `start`."""
    assert gradients.qpos is not None
    assert gradients.qvel is not None
    assert gradients.act is not None
    assert gradients.ctrl is not None
    qpos = tangent.project(start.qpos.expand(gradients.qpos.shape), gradients.qpos)
    return torch.cat((qpos, gradients.qvel, gradients.act), dim=-1), gradients.ctrl
