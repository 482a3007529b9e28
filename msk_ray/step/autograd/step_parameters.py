"""Parameters as inputs of autograd, bundled so that a step's gradient for all of them is one tensor.

`parameter_tensors` writes their values.

A rollout takes many steps with the same values. If each value were an input of each step, autograd would sum their
gradients one by one: for the ant's 30 parameters, that would be as many small kernels per step as the whole pullback.
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
    """Model parameters of a step."""

    values: dict[str, Tensor]
    """Their values by name, outside autograd."""
    wanted: tuple[str, ...]
    """Names of those that need a gradient."""
    bundle: Tensor | None
    """Autograd input that represents them: a tensor without contents, (W, N), whose gradient is the concatenation of
    theirs, with a row per world; None if `wanted` is empty."""


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
    """Makes the bundle of a step's parameters, shared by consecutive steps with the same values.

    Args:
        model: the parameters' model.
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
            # Weak references, so that autograd's graph of the values does not outlive the steps that use it.
            self._key = [(name, weakref.ref(value), value._version) for name, value in wanted.items()]
            self._last = weakref.ref(last)
        return last

    def _same(self, wanted: dict[str, Tensor]) -> bool:
        return len(wanted) == len(self._key) and all(
            name == known and value is kept() and value._version == version
            for (name, value), (known, kept, version) in zip(wanted.items(), self._key, strict=True)
        )
