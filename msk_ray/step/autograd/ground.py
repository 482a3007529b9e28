"""Distance to the ground below points, and scans of it around a body, with the gradient of the slope where rays land.

Axes: W worlds, R rays.
"""

from functools import cached_property
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from msk_ray.step.autograd.buffers import device_of, stream_of
from msk_ray.step.autograd.kinematics import Frames
from msk_ray.step.errors import ConfigError
from msk_ray.step.forward import Graph, WorldBatch
from msk_ray.step.forward.ground_rays import GroundRays


class _Distance(torch.autograd.Function):
    """Points to their distances above the ground.

    The ground near a landing point is the plane n·x = c, so that the distance along (0, 0, -1) has the slope n / n_z;
    a ray that lands nowhere within reach has none.
    """

    @staticmethod
    def forward(ctx: Any, rays: "_Rays", points: Tensor, reach: float) -> Tensor:
        distance, normal = rays.cast(points)
        lands = (distance >= 0.0) & (distance < reach)
        slope = normal / normal[..., 2:]
        ctx.save_for_backward(slope.where(lands[..., None], torch.zeros_like(slope)))
        return distance.where(lands, torch.full_like(distance, reach))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[None, Tensor, None]:
        (slope,) = ctx.saved_tensors
        return None, bar[..., None] * slope, None


class _Rays:
    """The launch of R rays in each world."""

    def __init__(self, rays: GroundRays, batch: WorldBatch, count: int) -> None:
        self._device = device_of(batch)
        shape = (batch.nworld, count)
        origin, normal = (wp.zeros(shape, dtype=wp.vec3, device=batch.device) for _ in range(2))
        distance = wp.zeros(shape, dtype=float, device=batch.device)
        self._origin, self._distance, self._normal = (
            wp.to_torch(array, requires_grad=False) for array in (origin, distance, normal)
        )
        self._graph = Graph(lambda: rays.launch(origin, distance, normal), batch.device)

    def cast(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (W, R) and normal (W, R, 3) below points (W, R, 3)."""
        self._origin.copy_(points)
        self._graph.replay(stream_of(self._device))
        return self._distance.clone(), self._normal.clone()


class Ground:
    """The geoms of a model that are fixed to the world and can be touched, of every type but flexes.

    Args:
        batch: the worlds.
    """

    def __init__(self, batch: WorldBatch) -> None:
        self._batch = batch
        self._rays: dict[int, _Rays] = {}

    @cached_property
    def _caster(self) -> GroundRays:
        return GroundRays(self._batch)

    def below(self, points: Tensor, reach: float) -> Tensor:
        """How far the ground is straight below points (W, R, 3) [m], (W, R); `reach` where it is not within that.

        Below the surface a point reads where its ray leaves a box, and `reach` under a plane.

        Raises:
            UnsupportedModelError: the model has no ground.
            ConfigError: the points are of another number of worlds.
        """
        if points.shape[0] != self._batch.nworld:
            raise ConfigError(f"points of {points.shape[0]} worlds, not {self._batch.nworld}: give (W, R, 3)")
        count = points.shape[1]
        if count not in self._rays:
            self._rays[count] = _Rays(self._caster, self._batch, count)
        distance: Tensor = _Distance.apply(self._rays[count], points, reach)
        return distance

    def scan(self, frames: Frames, body: str | int, offsets: Tensor, reach: float) -> Tensor:
        """How far below a body's origin the ground is around it [m], (W, R).

        Args:
            frames: the bodies.
            body: name or id.
            offsets: horizontal offsets of the rays (R, 2) [m], which turn with the heading of the body's x axis.
            reach: reading where the ground is not within this distance [m].
        """
        heading = torch.nn.functional.normalize(frames.axis(body, 0)[:, None, :2], dim=-1)
        ahead, left = offsets[:, :1] * heading, offsets[:, 1:] * heading.roll(1, -1)
        sideways = torch.stack((-left[..., 0], left[..., 1]), dim=-1)
        moved = torch.nn.functional.pad(ahead + sideways, (0, 1))
        return self.below(frames.position(body)[:, None] + moved, reach)


def grid(length: float, width: float, spacing: float) -> Tensor:
    """Offsets of a grid of rays around the origin, (R, 2) [m]: along x first."""
    x, y = (spacing * (torch.arange(n := round(size / spacing) + 1) - (n - 1) / 2) for size in (length, width))
    return torch.cartesian_prod(y, x).flip(-1)
