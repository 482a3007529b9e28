"""Legged robots that follow commands on rough ground. Source: `mjlab/tasks/velocity` of mjlab 1.6.0.

Axes: W worlds, F feet, P points of the scan.
"""

import mujoco
import torch
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.layout import Entry, entries
from msk_ray.robots.config import GO1_ROUGH_TERMS, ROUGH_VELOCITY, Go1VelocityRoughSettings
from msk_ray.robots.env import VelocityEnv
from msk_ray.robots.terms import COLLISION_FORCE
from msk_ray.robots.terrain import KINDS, Terrain
from msk_ray.robots.unitree import GO1
from msk_ray.step import StepState
from msk_ray.step.autograd.ground import grid
from msk_ray.step.autograd.tangent import quat_rotate

_REACH = 5.0
"""Reach of the scan; the observation divides its readings by it [m]."""
_RING = 0.04
"""Radius around a foot within which the highest ground counts for the foot's height [m]."""
_ABOVE = 1.0
"""Height above a foot at which rays begin, so that they do not begin inside the ground [m]."""
_FITTED = 32
"""Number of scanned points to which a plane of the ground is fitted."""
_ROUGHEST_PLANE = 0.1
"""Variance across a fitted plane, as a share of the variance along it, from which the ground counts as level."""


class Go1VelocityRough(VelocityEnv[Go1VelocityRoughSettings]):
    """mjlab's `Mjlab-Velocity-Rough-Unitree-Go1`: patches of stairs, slopes, noise and waves.

    The observation ends with the scan: the height of the trunk above the ground at 11 × 17 points around it, divided by
    5 m. The height of a foot is measured from the highest ground within 4 cm. Episodes begin in the middle of a patch
    and end when a thigh hits the ground.
    """

    Settings = Go1VelocityRoughSettings
    commands = (ROUGH_VELOCITY,)
    mjcf = "scenes/go1_flat.xml"
    robot = GO1
    terms = GO1_ROUGH_TERMS
    thighs = tuple(f"{leg}_thigh_collision{k}" for leg in GO1.feet for k in (1, 2, 3))
    shanks = tuple(f"{leg}_calf_collision{k}" for leg in GO1.feet for k in (1, 2))
    trunk_and_head = ("trunk_collision", "head_collision")
    scan_points = grid(1.6, 1.0, 0.1)

    @classmethod
    def edit(cls, spec: mujoco.MjSpec, config: Go1VelocityRoughSettings, physics: PhysicsConfig) -> None:
        super().edit(spec, config, physics)
        spec.option.ccd_iterations = 500
        Terrain(config.terrain_rows).add_to(spec, "terrain")

    def prepare(self) -> None:
        super().prepare()
        self._middles = self.tensor(Terrain(self.config.terrain_rows).starts)
        self._shares_up_to = self.tensor(list(KINDS.values())).cumsum(0)[:-1]
        self._scanned = self.scan_points.to(self.device)
        self._fitted = torch.linspace(0, len(self._scanned) - 1, _FITTED, device=self.device).long()
        self._ahead = self.tensor([1.0, 0.0, 0.0])

    # Episodes

    def draw_physics(self, count: int) -> StepState:
        start = super().draw_physics(count)
        row, kind = ((self.uniform(count, 2) + 1.0) / 2.0).T.contiguous()
        middle = self._middles[(row * len(self._middles)).long(), torch.bucketize(kind, self._shares_up_to, right=True)]
        return start._replace(qpos=torch.cat((start.qpos[:, :3] + middle, start.qpos[:, 3:]), dim=-1))

    def has_fallen(self, state: StepState) -> Tensor:
        return self.hits(state, self.thighs) > 0

    def base_height(self, state: StepState) -> Tensor:
        return self.ground.below(state.qpos[:, None, :3], _REACH)[:, 0]

    # What terms and observation use

    def hits(self, state: StepState, geoms: tuple[str, ...]) -> Tensor:
        """Number of substeps in which one of these geoms hit the ground with more than 10 N, (W,)."""
        strongest = self.contact(state, geoms, "geom", "terrain", "body").strongest
        return (strongest > COLLISION_FORCE).any(-1).sum(0)

    def foot_heights(self, state: StepState) -> Tensor:
        """Heights of the feet above the highest ground around them [m], at least 0, (W, F)."""
        frames, feet = self.frames(state), self.robot.feet
        position, orientation = frames.site_position(feet), frames.site_orientation(feet)
        axis = quat_rotate(orientation, self._ahead.expand_as(position))[..., :2]
        ahead = _RING * torch.nn.functional.normalize(axis, dim=-1)
        left = torch.stack((-ahead[..., 1], ahead[..., 0]), dim=-1)
        around = torch.stack((torch.zeros_like(ahead), ahead, left, -ahead, -left), dim=2)
        above = position[:, :, None] + torch.nn.functional.pad(around, (0, 1), value=_ABOVE)
        height = self.ground.below(above.flatten(1, 2), 2.0 * _ABOVE) - _ABOVE
        return height.unflatten(1, above.shape[1:3]).amin(-1).clamp_min(0.0)

    def scan(self, state: StepState) -> Tensor:
        """Height of the trunk above the ground around it [m], (W, P)."""
        return self.measurements.once(
            "scan", state, lambda: self.ground.scan(self.frames(state), self.robot.trunk, self._scanned, _REACH)
        )

    def tilt_to_ground(self, state: StepState) -> Tensor:
        """(Sine of the angle between the trunk's z axis and the normal of the ground around it)², (W,)."""
        up = self.frames(state).axis(self.robot.trunk, 2)
        ahead = torch.nn.functional.normalize(self.frames(state).axis(self.robot.trunk, 0)[:, :2], dim=-1)
        # `along` and `across` are components in axes that turn with the heading, as the scan's points do.
        along = (up[:, :2] * ahead).sum(-1)
        across = up[:, 1] * ahead[:, 0] - up[:, 0] * ahead[:, 1]
        height = -self.scan(state)[:, self._fitted]
        where = self._scanned[self._fitted].expand(self.nworld, -1, 2)
        normal = plane_normal(torch.cat((where, height[..., None]), dim=-1), -self._down)
        return 1.0 - (normal * torch.stack((along, across, up[:, 2]), dim=-1)).sum(-1).square()

    def observe(self, state: StepState, action: Tensor) -> Tensor:
        return torch.cat((super().observe(state, action), self.scan(state) / _REACH), dim=-1)

    def observation_layout(self) -> list[Entry]:
        names = (f"scan_{x:+.1f}_{y:+.1f}" for x, y in self.scan_points.tolist())
        return [*super().observation_layout(), *entries(names, "5 m")]


def plane_normal(points: Tensor, up: Tensor) -> Tensor:
    """Unit normals (W, 3) of the planes fitted by least squares to points (W, P, 3); `up` (3,) where the points are far
    from any plane."""
    centred = points - points.mean(1, keepdim=True)
    covariance = centred.mT @ centred
    # The normal is the eigenvector with the smallest eigenvalue, which is the adjugate's largest: taking powers of the
    # adjugate leaves that eigenvector alone.
    rows = covariance.unbind(1)
    adjugate = torch.stack([torch.linalg.cross(rows[(k + 1) % 3], rows[(k + 2) % 3]) for k in range(3)], dim=1)
    power = adjugate
    for _ in range(4):
        power = power / power.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None]
        power = power @ power
    normal = torch.nn.functional.normalize(power[:, :, 2], dim=-1)
    smallest = (normal * (covariance @ normal[..., None])[..., 0]).sum(-1)
    others = covariance.diagonal(dim1=1, dim2=2).sum(-1) - smallest
    product = adjugate.diagonal(dim1=1, dim2=2).sum(-1) - smallest * others
    middle = (others - (others.square() - 4.0 * product).clamp_min(0.0).sqrt()) / 2.0
    return torch.where((smallest < _ROUGHEST_PLANE * middle)[:, None], normal, up)
