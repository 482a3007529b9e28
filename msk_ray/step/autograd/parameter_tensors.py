"""Values of parameters on their way into the arrays of a batch: their shapes are checked, derived fields computed.

`step_parameters` leads gradients back to them; `forward.parameters` lists what can be a parameter.

Axes: W worlds, B bodies, G geoms.
"""

from collections.abc import Mapping
from functools import cached_property
from operator import attrgetter

import mujoco
import numpy as np
import torch
import warp as wp
from torch import Tensor

from msk_ray.step.errors import ConfigError
from msk_ray.step.forward import WorldBatch
from msk_ray.step.forward.parameters import DERIVED, PARAMETERS


class ParameterTensors:
    """Writes values of a batch's parameters into the arrays that recorded steps read."""

    def __init__(self, batch: WorldBatch) -> None:
        self._model = batch.mjm
        self._device = torch.device(str(batch.device))
        self._views: dict[str, Tensor] = {}
        self._nominal: dict[str, Tensor] = {}
        self._loaded: dict[str, tuple[Tensor, int]] | None = None
        self._replayed = False
        for name in batch.parameters:
            for field in (name, *DERIVED.get(name, ())):
                self._views[field] = wp.to_torch(attrgetter(field)(batch.model), requires_grad=False)
                nominal = torch.as_tensor(np.asarray(attrgetter(field)(batch.mjm)), dtype=torch.float32)
                self._nominal[field] = nominal.to(self._device)

    @torch.no_grad()
    def load(self, values: Mapping[str, Tensor]) -> None:
        """Write `values`, each for all worlds or with a row per world; other parameters get the model's own values."""
        if not self._views:
            return
        self._replayed |= _recording(self._device)
        # A reference keeps their memory from being reused by other tensors.
        self._loaded = {name: (value.detach(), value._version) for name, value in values.items()}
        values = dict(values)
        if "body_mass" in values:
            values["body_subtreemass"] = values["body_mass"] @ self._subtrees
        if "geom_size" in values:
            values["geom_rbound"], values["geom_aabb"] = self._bounds(values["geom_size"])
        for name, view in self._views.items():
            value = values.get(name, self._nominal[name])
            rows = value.shape[: value.dim() - self._nominal[name].dim()]
            view.copy_(value.reshape((*rows, *view.shape[1:])))

    def hold(self, values: Mapping[str, Tensor]) -> None:
        """Write `values`, unless the same unchanged tensors were written last.

        Once a graph has recorded a write, always writes: a replay may have written other values since.
        """
        if self._replayed or _recording(self._device) or not self._holds(values):
            self.load(values)

    def _holds(self, values: Mapping[str, Tensor]) -> bool:
        if self._loaded is None or self._loaded.keys() != values.keys():
            return False
        return all(
            value._version == version
            and value.data_ptr() == kept.data_ptr()
            and (value.shape, value.stride()) == (kept.shape, kept.stride())
            for value, (kept, version) in ((value, self._loaded[name]) for name, value in values.items())
        )

    @cached_property
    def _subtrees(self) -> Tensor:
        """Entry (i, j) is 1 if body i is body j or a descendant of it, else 0; shape (B, B)."""
        out = torch.eye(self._model.nbody)
        for body in range(self._model.nbody - 1, 0, -1):
            out[:, self._model.body_parentid[body]] += out[:, body]
        return out.to(self._device)

    @cached_property
    def _kinds(self) -> list[Tensor]:
        """Which geoms are spheres, capsules, cylinders, ellipsoids and boxes, each (G,)."""
        kinds = mujoco.mjtGeom
        solids = (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER, kinds.mjGEOM_ELLIPSOID)
        return [
            torch.as_tensor(self._model.geom_type == kind, device=self._device) for kind in (*solids, kinds.mjGEOM_BOX)
        ]

    def _bounds(self, size: Tensor) -> tuple[Tensor, Tensor]:
        """Bounding radius (..., G) and box (..., G, 6) of geoms of these sizes, as MuJoCo's compiler computes them."""
        radius, half, third = size.unbind(-1)
        ball, capsule, cylinder, ellipsoid, box = self._kinds
        bound = self._nominal["geom_rbound"].expand(radius.shape).clone()
        for of_type, value in (
            (ball, radius),
            (capsule, radius + half),
            (cylinder, torch.hypot(radius, half)),
            (ellipsoid, size.amax(-1)),
            (box, size.norm(dim=-1)),
        ):
            bound = torch.where(of_type, value, bound)
        length = torch.where(box | ellipsoid, third, torch.where(cylinder, half, torch.where(capsule, bound, radius)))
        width = torch.where(box | ellipsoid, half, radius)
        centre, extent = self._nominal["geom_aabb"].expand(*radius.shape, 6).split(3, -1)
        known = (ball | capsule | cylinder | ellipsoid | box)[:, None]
        return bound, torch.cat(
            (centre, torch.where(known, torch.stack((radius, width, length), dim=-1), extent)), dim=-1
        )


def _recording(device: torch.device) -> bool:
    return device.type == "cuda" and torch.cuda.is_current_stream_capturing()


def check_values(model: mujoco.MjModel, nworld: int, values: Mapping[str, Tensor], device: torch.device) -> None:
    """Raise ConfigError for a value with another shape than the model's field, or a wrong dtype or device."""
    for name, value in values.items():
        shape = PARAMETERS[name].value(model).shape
        if value.shape not in (shape, (nworld, *shape)):
            raise ConfigError(
                f"step: parameter {name} has shape {tuple(value.shape)}, but this model takes {shape} for all worlds, "
                f"or {(nworld, *shape)} with a row per world"
            )
        if value.dtype != torch.float32:
            raise ConfigError(f"step: parameter {name} is {value.dtype}: write {name}.float()")
        if value.device != device:
            raise ConfigError(
                f"step: parameter {name} is on {value.device}, the simulation on {device}: write .to({str(device)!r})"
            )
