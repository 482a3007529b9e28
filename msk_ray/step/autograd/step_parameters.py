"""Values of parameters of the model on their way into autograd: together, so that a step's gradient is one tensor.

A rollout takes many steps with the same values. If each value were an input of each step, autograd would sum their
gradients one by one: for the ant's 30 parameters as many small kernels a step as its whole pullback has.
"""

import weakref
from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from msk_ray.step.forward.parameters import PARAMETERS


class StepParameters(NamedTuple):
    """Parameters of the model in a step."""

    values: dict[str, Tensor]
    """Their values by name, outside autograd."""
    wanted: tuple[str, ...]
    """Names of those that need a gradient."""
    bundle: Tensor | None
    """What autograd takes for them: a tensor without contents, (W, N), whose gradient is theirs side by side, with a
    row per world; None if `wanted` is empty."""


class _Bundle(torch.autograd.Function):
    """Values (own shape, or W rows of it) to their bundle."""

    @staticmethod
    def forward(ctx: Any, nworld: int, own: list[torch.Size], *values: Tensor) -> Tensor:
        ctx.own, ctx.shapes = own, [value.shape for value in values]
        return values[0].new_zeros(()).expand(nworld, sum(shape.numel() for shape in own))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, rows: Tensor) -> tuple[Tensor | None, ...]:
        sizes = [own.numel() for own in ctx.own]
        of_worlds = rows.split(sizes, dim=1)
        of_all = rows.sum(0).split(sizes) if any(map(torch.Size.__eq__, ctx.shapes, ctx.own)) else of_worlds
        return (
            None,
            None,
            *(
                (summed if shape == own else each).reshape(shape)
                for each, summed, own, shape in zip(of_worlds, of_all, ctx.own, ctx.shapes, strict=True)
            ),
        )


class Bundles:
    """Makes the bundle of a step's parameters, one for all steps that follow each other with the same values.

    Args:
        model: whose parameters they are.
        nworld: number of worlds.
    """

    def __init__(self, model: mujoco.MjModel, nworld: int) -> None:
        self._model, self._nworld = model, nworld
        self._key: list[tuple[str, weakref.ref[Tensor], int]] = []
        self._last: weakref.ref[Tensor] | None = None

    def of(self, values: Mapping[str, Tensor]) -> StepParameters:
        """The parameters of a step; `values` must have been checked."""
        wanted = {n: v for n, v in values.items() if v.requires_grad} if torch.is_grad_enabled() else {}
        plain = {name: value.detach() for name, value in values.items()}
        return StepParameters(plain, tuple(wanted), self._bundle(wanted) if wanted else None)

    def _bundle(self, wanted: dict[str, Tensor]) -> Tensor:
        last = self._last() if self._last is not None and self._same(wanted) else None
        if last is None:
            own = [torch.Size(PARAMETERS[name].value(self._model).shape) for name in wanted]
            last = _Bundle.apply(self._nworld, own, *wanted.values())
            # Weakly: autograd's graph of the values must not outlive the steps that use it.
            self._key = [(name, weakref.ref(value), value._version) for name, value in wanted.items()]
            self._last = weakref.ref(last)
        return last

    def _same(self, wanted: dict[str, Tensor]) -> bool:
        return len(wanted) == len(self._key) and all(
            name == known and value is kept() and value._version == version
            for (name, value), (known, kept, version) in zip(wanted.items(), self._key, strict=True)
        )
