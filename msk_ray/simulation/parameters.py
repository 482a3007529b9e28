"""Parameters of the model as tensors: their shapes, their way into a batch's model, and what follows from them.

Axes: W worlds, B bodies, G geoms.
"""

from collections.abc import Mapping

import mujoco
import torch
import warp as wp
from torch import Tensor

from msk_ray.errors import ConfigError
from msk_ray.physics import WorldBatch
from msk_ray.physics.parameters import PARAMETERS


class ParameterTensors:
    """Writes values of a batch's parameters into the arrays that recorded steps read."""

    def __init__(self, batch: WorldBatch) -> None:
        device = torch.device(str(batch.device))
        self._views: dict[str, Tensor] = {}
        self._nominal: dict[str, Tensor] = {}
        for name in batch.parameters:
            parameter = PARAMETERS[name]
            self._views[name] = wp.to_torch(parameter.array(batch.model), requires_grad=False)
            self._nominal[name] = torch.as_tensor(parameter.value(batch.mjm), dtype=torch.float32, device=device)

    @torch.no_grad()
    def load(self, values: Mapping[str, Tensor]) -> None:
        """Write `values`, each for all worlds or with a row per world; a parameter without one gets the model's own."""
        for name, view in self._views.items():
            view.copy_(values.get(name, self._nominal[name]))


def check_values(model: mujoco.MjModel, nworld: int, values: Mapping[str, Tensor], place: torch.device) -> None:
    """Raise ConfigError where a value has another shape, dtype or device than the model's field of that name."""
    for name, value in values.items():
        shape = PARAMETERS[name].value(model).shape
        if value.shape not in (shape, (nworld, *shape)):
            raise ConfigError(
                f"step: parameter {name} has shape {tuple(value.shape)}, but this model takes {shape} for all worlds, "
                f"or {(nworld, *shape)} with a row per world"
            )
        if value.dtype != torch.float32:
            raise ConfigError(f"step: parameter {name} is {value.dtype}: write {name}.float()")
        if value.device != place:
            raise ConfigError(
                f"step: parameter {name} is on {value.device}, the simulation on {place}: write .to({str(place)!r})"
            )


def gradient_of(value_shape: torch.Size, gradient: Tensor) -> Tensor:
    """The gradient of a value from those of each world, (W, ...): their sum where one value was for all worlds."""
    return gradient if gradient.shape == value_shape else gradient.sum(0)
