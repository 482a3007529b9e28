"""Positions and velocities of bodies, sites and centres of mass, as autograd functions of (qpos, qvel).

Axes: W worlds, B bodies, n names in a list.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from msk_ray.step.adjoint.forward_kinematics import FrameWalk
from msk_ray.step.autograd.buffers import stream_of
from msk_ray.step.autograd.tangent import quat_multiply, quat_rotate
from msk_ray.step.errors import ConfigError
from msk_ray.step.forward import Graph, WorldBatch

Names = str | int | Sequence[str | int]
"""One name or id, for results without axis n, or several."""


def as_named(values: Tensor, names: Names) -> Tensor:
    """Values (W, n, ·) of named elements, without axis n for a single name.

    Squeezing avoids indexing with an id on the device, which would make the host wait and prevent recording.
    """
    return values.squeeze(1) if isinstance(names, str | int) else values


class _Walk(torch.autograd.Function):
    """(qpos, qvel) to the frames of all bodies, differentiable once in both."""

    @staticmethod
    def forward(ctx: Any, kinematics: "Kinematics", qpos: Tensor, qvel: Tensor) -> tuple[Tensor, ...]:
        ctx.kinematics = kinematics
        frames = kinematics.evaluate(qpos, qvel)
        ctx.save_for_backward(qpos, qvel, *frames)
        return frames

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *bars: Tensor) -> tuple[None, Tensor, Tensor]:
        qpos, qvel, *frames = ctx.saved_tensors
        return (None, *ctx.kinematics.pull_back(qpos, qvel, frames, bars))


class _Constants(NamedTuple):
    """Constants for centres of mass, on the device."""

    mass: Tensor
    """Mass of each body [kg], (B,)."""
    inertia: Tensor
    """Principal moments of each body [kg m²], (B, 3)."""
    center: Tensor
    """Centre of mass of each body in its own frame [m], (B, 3)."""
    axes: Tensor
    """Principal axes of each body in its own frame, quaternions (w, x, y, z), (B, 4)."""
    subtree: Tensor
    """Whether body j is in the subtree of body i, 0 or 1, (B, B)."""


class Kinematics:
    """Computes `Frames` for states of `nworld` worlds.

    Its launches are recorded once, separately from the step, and share no buffers with it.

    Args:
        batch: the worlds.
    """

    def __init__(self, batch: WorldBatch) -> None:
        model = batch.mjm
        self.model = model
        self._device = torch.device(str(batch.device))
        self._batch_device = batch.device
        self._walk = FrameWalk(model, batch.nworld, batch.device)

        def view(array: wp.array) -> Tensor:
            tensor: Tensor = wp.to_torch(array, requires_grad=False)
            return tensor

        self._inputs = view(self._walk.qpos), view(self._walk.qvel)
        self._results = tuple(view(array) for array in self._walk.frames)
        self._bars = tuple(view(array) for array in self._walk.bars)
        self._gradients = view(self._walk.grad_qpos), view(self._walk.grad_qvel)
        self._forward = Graph(self._walk.launch_forward, batch.device)
        self._backward: Graph | None = None
        self.body_frame = torch.tensor(self._walk.body_frame, device=self._device)
        self.constants = self._constants()
        self._found: dict[tuple[str, Names], Tensor] = {}

    def __call__(self, qpos: Tensor, qvel: Tensor) -> "Frames":
        """Frames of the states qpos (W, nq) and qvel (W, nv)."""
        if torch.is_grad_enabled() and (qpos.requires_grad or qvel.requires_grad):
            return Frames(self, *_Walk.apply(self, qpos, qvel))
        return Frames(self, *self.evaluate(qpos, qvel))

    @torch.no_grad()
    def evaluate(self, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, ...]:
        """The forward pass alone, outside autograd."""
        self._load(qpos, qvel)
        self._forward.replay(stream_of(self._device))
        return tuple(result.clone() for result in self._results)

    @torch.no_grad()
    def pull_back(
        self, qpos: Tensor, qvel: Tensor, frames: Sequence[Tensor], bars: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Gradients of raw qpos (W, nq) and of qvel (W, nv) for cotangents of the frames that `evaluate` found."""
        if self._backward is None:
            self._backward = Graph(self._walk.launch_pullback, self._batch_device)
        self._load(qpos, qvel)
        for view, value in zip((*self._results, *self._bars), (*frames, *bars), strict=True):
            view.copy_(value)
        self._backward.replay(stream_of(self._device))
        grad_qpos, grad_qvel = self._gradients
        return grad_qpos.clone(), grad_qvel.clone()

    def indices(self, kind: str, names: Names) -> Tensor:
        """Ids of bodies, sites or geoms by name or id, (n,); n is 1 for a single one.

        Args:
            kind: `body`, `site` or `geom`.
            names: one name or id, or several.

        Raises:
            ConfigError: the model has no such element.
        """
        key = (kind, names if isinstance(names, str | int) else tuple(names))
        if key not in self._found:
            several = [names] if isinstance(names, str | int) else names
            ids = [self.id(kind, name) for name in several]
            self._found[key] = torch.tensor(ids, device=self._device)
        return self._found[key]

    def id(self, kind: str, name: str | int) -> int:
        """Id of a `body`, `site` or `geom` by name or id.

        Raises:
            ConfigError: the model has no such element.
        """
        accessor = getattr(self.model, kind)
        count = getattr(self.model, f"n{kind}")
        if isinstance(name, int):
            if not 0 <= name < count:
                raise ConfigError(f"the model has no {kind} {name}: write 0 to {count - 1}, or a name")
            return name
        try:
            return int(accessor(name).id)
        except KeyError:
            known = [str(accessor(i).name) for i in range(count) if accessor(i).name]
            listed = ", ".join(known[:20]) + (", ..." if len(known) > 20 else "")
            raise ConfigError(f"the model has no {kind} {name!r}: it has {listed or 'none with a name'}") from None

    def place(self, kind: str) -> tuple[Tensor, Tensor, Tensor]:
        """Body, position [m] and orientation (w, x, y, z) in the body's frame of each site or geom."""
        frame: tuple[Tensor, Tensor, Tensor] = getattr(self, f"_{kind}_places")
        return frame

    @cached_property
    def _site_places(self) -> tuple[Tensor, Tensor, Tensor]:
        m = self.model
        return self.tensor(m.site_bodyid, torch.long), self.tensor(m.site_pos), self.tensor(m.site_quat)

    @cached_property
    def _geom_places(self) -> tuple[Tensor, Tensor, Tensor]:
        m = self.model
        return self.tensor(m.geom_bodyid, torch.long), self.tensor(m.geom_pos), self.tensor(m.geom_quat)

    def _load(self, qpos: Tensor, qvel: Tensor) -> None:
        for view, value in zip(self._inputs, (qpos, qvel), strict=True):
            view.copy_(value)

    def tensor(self, values: object, dtype: torch.dtype = torch.float32) -> Tensor:
        """Numbers of the model on the device of the frames, floats in their precision."""
        return torch.as_tensor(np.array(values), dtype=dtype, device=self._device)

    def _constants(self) -> _Constants:
        m = self.model
        subtree = np.eye(m.nbody)
        for body in range(m.nbody - 1, 0, -1):
            subtree[m.body_parentid[body]] += subtree[body]
        return _Constants(
            self.tensor(m.body_mass),
            self.tensor(m.body_inertia),
            self.tensor(m.body_ipos),
            self.tensor(m.body_iquat),
            self.tensor(subtree),
        )


class Frames:
    """Bodies, sites, geoms and centres of mass in one state, in world coordinates, all with gradients.

    Every method takes a name or an id and returns (W, ·), or a list of them and returns (W, n, ·). Results are cached.
    """

    def __init__(self, kinematics: Kinematics, pos: Tensor, quat: Tensor, linvel: Tensor, angvel: Tensor) -> None:
        self._kinematics = kinematics
        frame = kinematics.body_frame
        self._pos, self._linvel, self._angvel = (t.index_select(1, frame) for t in (pos, linvel, angvel))
        self._quat = quat.index_select(1, frame).roll(1, -1)  # Warp's (x, y, z, w) to MuJoCo's (w, x, y, z)

    def position(self, body: Names) -> Tensor:
        """Origin of bodies [m], (W, 3) or (W, n, 3)."""
        return as_named(self._pos[:, self._kinematics.indices("body", body)], body)

    def orientation(self, body: Names) -> Tensor:
        """Orientation of bodies, unit quaternions (w, x, y, z), (W, 4) or (W, n, 4)."""
        return as_named(self._quat[:, self._kinematics.indices("body", body)], body)

    def velocity(self, body: Names) -> Tensor:
        """Velocity of bodies' origins [m/s], (W, 3) or (W, n, 3)."""
        return as_named(self._linvel[:, self._kinematics.indices("body", body)], body)

    def angular_velocity(self, body: Names) -> Tensor:
        """Angular velocity of bodies [rad/s], (W, 3) or (W, n, 3)."""
        return as_named(self._angvel[:, self._kinematics.indices("body", body)], body)

    def axis(self, body: Names, axis: int) -> Tensor:
        """Direction of axis 0, 1 or 2 (x, y, z) of bodies, unit vectors (W, 3) or (W, n, 3)."""
        quat = self.orientation(body)
        unit = torch.eye(3, dtype=quat.dtype, device=quat.device)[axis]
        return quat_rotate(quat, unit.expand(*quat.shape[:-1], 3))

    def site_position(self, site: Names) -> Tensor:
        """Position of sites [m], (W, 3) or (W, n, 3)."""
        return self._point("site", site)[0]

    def site_orientation(self, site: Names) -> Tensor:
        """Orientation of sites, unit quaternions (w, x, y, z), (W, 4) or (W, n, 4)."""
        ids = self._kinematics.indices("site", site)
        body, _, quat = self._kinematics.place("site")
        own = self._quat[:, body[ids]]
        return as_named(quat_multiply(own, quat[ids].expand_as(own)), site)

    def site_velocity(self, site: Names) -> Tensor:
        """Velocity of sites [m/s], (W, 3) or (W, n, 3)."""
        return self._point("site", site)[1]

    def geom_position(self, geom: Names) -> Tensor:
        """Centre of geoms [m], (W, 3) or (W, n, 3)."""
        return self._point("geom", geom)[0]

    def geom_velocity(self, geom: Names) -> Tensor:
        """Velocity of geoms' centres [m/s], (W, 3) or (W, n, 3)."""
        return self._point("geom", geom)[1]

    def fixed_points(self, bodies: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Position [m] and velocity [m/s], both (W, n, 3), of points fixed in bodies.

        Args:
            bodies: ids, (n,).
            offsets: positions in the bodies' frames [m], (n, 3).
        """
        quat = self._quat[:, bodies]
        arm = quat_rotate(quat, offsets.expand(*quat.shape[:-1], 3))
        return self._pos[:, bodies] + arm, self._linvel[:, bodies] + torch.linalg.cross(self._angvel[:, bodies], arm)

    def center_of_mass(self, body: Names = 0) -> Tensor:
        """Centre of mass of the subtrees of bodies, by default of the whole model [m], (W, 3) or (W, n, 3)."""
        return self._subtree(self._centers[0], body)

    def com_velocity(self, body: Names = 0) -> Tensor:
        """Velocity of that centre of mass [m/s], (W, 3) or (W, n, 3)."""
        return self._subtree(self._centers[1], body)

    def angular_momentum(self, body: Names = 0) -> Tensor:
        """Angular momentum of the subtrees of bodies about their centres of mass [kg m²/s], (W, 3) or (W, n, 3)."""
        c = self._kinematics.constants
        ids = self._kinematics.indices("body", body)
        members = c.subtree[ids]  # (n, B)
        position, velocity = self._centers
        axes = quat_multiply(self._quat, c.axes.expand_as(self._quat))
        spin = quat_rotate(torch.cat((axes[..., :1], -axes[..., 1:]), -1), self._angvel)
        own = quat_rotate(axes, c.inertia * spin)
        about = own + c.mass[:, None] * torch.linalg.cross(position, velocity)
        total = as_named(torch.einsum("nb,wbk->wnk", members, about), body)
        mass = as_named((members @ c.mass)[None, :, None], body)
        # Σ m r × v about the origin equals the sum about the centre of mass plus M c × v_c.
        return total - mass * torch.linalg.cross(self.center_of_mass(body), self.com_velocity(body))

    @cached_property
    def _centers(self) -> tuple[Tensor, Tensor]:
        """Each body's own centre of mass and its velocity, (W, B, 3)."""
        arm = quat_rotate(self._quat, self._kinematics.constants.center.expand_as(self._pos))
        return self._pos + arm, self._linvel + torch.linalg.cross(self._angvel, arm)

    def _subtree(self, values: Tensor, body: Names) -> Tensor:
        c = self._kinematics.constants
        weights = c.subtree[self._kinematics.indices("body", body)] * c.mass
        return as_named(torch.einsum("nb,wbk->wnk", weights / weights.sum(-1, keepdim=True), values), body)

    def _point(self, kind: str, names: Names) -> tuple[Tensor, Tensor]:
        ids = self._kinematics.indices(kind, names)
        body, pos, _ = self._kinematics.place(kind)
        position, velocity = self.fixed_points(body[ids], pos[ids])
        return as_named(position, names), as_named(velocity, names)
