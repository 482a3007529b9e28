"""`myoleg26` standing or walking along +x."""

import math

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.layout import Entry
from msk_ray.legs.assistance import LATERAL, righting
from msk_ray.legs.env import LegEnv
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.legs.myoleg26.model import SIDES, build_myoleg26
from msk_ray.legs.myoleg26.poses import cycle_states
from msk_ray.legs.myoleg26.tables import JOINTS
from msk_ray.legs.myoleg26.terrain import Terrain
from msk_ray.legs.root import Root
from msk_ray.step import StepState


class MyoLeg26(LegEnv[MyoLeg26Settings]):
    """The pose of the pelvis in the observation (4): its position to the right of its line [m], its tilt, list and
    rotation [rad].

    The pelvis has three slides and three hinges, so that tilt and list are coordinates and no quaternion is needed.
    """

    Settings = MyoLeg26Settings
    pose_signs = (-1.0, 1.0, -1.0, -1.0)
    keeps_iterations = True

    @classmethod
    def build_model(cls, config: MyoLeg26Settings, physics: PhysicsConfig) -> mujoco.MjModel:
        return build_myoleg26(config, physics)

    def prepare_model(self) -> None:
        model = self.model
        self.hinges = [model.joint(f"{hinge.name}_{side}").id for side in SIDES for hinge in JOINTS]
        self.stand_height = float(model.key("stand").qpos[1])
        terrain = Terrain(self.config.terrain)
        self._slope = terrain.slope
        self._plane = not len(terrain.edges)
        self._edges = self.tensor(terrain.edges)
        self._levels = self.tensor(terrain.levels)
        self._ranges = tuple(self.tensor(bound) for bound in model.jnt_range[self.hinges].T)
        names = {"stand": ["stand"], "walk": ["walk_left", "walk_right"]}
        names["mixed"] = names["stand"] + names["walk"]
        names["cycle"] = names["stand"]
        keys = [model.key(name) for name in names[self.config.reset]]
        self._starts = StepState(
            *(self.tensor([getattr(key, part) for key in keys]) for part in ("qpos", "qvel", "act"))
        )
        if self.config.reset == "cycle":
            self._cycle = StepState(*map(self.tensor, cycle_states(model)))
        mass = float(model.body_subtreemass[0])
        stiffness, damping = righting()
        self._springs = self.tensor([0.0, 0.0, LATERAL, *stiffness])
        self._dampers = self.tensor([0.0, 0.0, 2.0 * math.sqrt(LATERAL * mass), *damping])
        self._upright_pose = self.tensor(model.key("stand").qpos[:6])

    def control(self, action: Tensor) -> Tensor:
        excitation = super().control(action)
        if not self.config.assist.epochs:
            return excitation
        qpos, qvel, _ = self.state.physics
        force = -self._springs * (qpos[:, :6] - self._upright_pose) - self._dampers * qvel[:, :6]
        return torch.cat((excitation, self.assistance.share * force), dim=-1)

    def draw_physics(self, count: int) -> StepState:
        if len(self._starts.qpos) > 1 and self.config.stochastic_reset:
            source = self.generator.device
            pick = torch.randint(len(self._starts.qpos), (count,), generator=self.generator, device=source)
            pick = pick.to(self.device)
        else:
            pick = torch.zeros(count, dtype=torch.long, device=self.device)
        return self._near(StepState(*(part[pick].clone() for part in self._starts)))

    def draw_phase(self, phase: Tensor, speed: Tensor) -> StepState:
        if self.config.reset != "cycle":
            return super().draw_phase(phase, speed)
        count = len(self._cycle.qpos)
        qpos, qvel, act = (part[(phase * count).round().long() % count].clone() for part in self._cycle)
        # The table is for one stride per second at rest.
        qvel *= self.reference.pace.strides_per_second(speed)[:, None]
        qvel[:, 0] += speed
        return self._near(StepState(qpos, qvel, act))

    def _near(self, start: StepState) -> StepState:
        """These initial states with noise."""
        noise = self.config.reset_noise
        qpos, qvel, act = start
        count = len(qpos)
        # Positions stay, because a foot must not start inside the ground. Noise goes on hinges, including the pelvis's.
        qpos[:, 3:] += noise * self.uniform(count, self.model.nq - 3)
        qpos[:, 6:] = qpos[:, 6:].clamp(*self._ranges)
        qpos[:, 1] += 0.2 * noise * (1.0 + self.uniform(count, 1)[:, 0])
        qvel += 5.0 * noise * self.uniform(count, self.model.nv)
        return StepState(qpos, qvel, act)

    def ground_height(self, x: Tensor) -> Tensor:
        """Height of the ground [m] at x (W,) [m]; flat between its edges, so without a slope of its own there."""
        if self._plane:
            return self._slope * x
        return self._levels[torch.bucketize(x.detach(), self._edges)]

    def people_poses(self) -> NDArray[np.float64]:
        return cycle_states(self.model)[0]

    def pose_layout(self) -> list[Entry]:
        joints = self.model.jnt_qposadr.tolist()
        names = [self.model.joint(joints.index(place)).name for place in range(2, 6)]
        return [Entry(name, unit) for name, unit in zip(names, ("m", "rad", "rad", "rad"), strict=True)]

    def measure_root(self, state: StepState) -> Root:
        # Taken apart at once: the gradients of columns taken one by one would be added up one by one.
        x, height, right, *_ = state.qpos[:, :6].unbind(-1)
        forward, upward, rightward, tilting, leaning, turning = state.qvel[:, :6].unbind(-1)
        angles = state.qpos[:, 3:6]
        sin_tilt, sin_lean, sin_turn = torch.sin(angles).unbind(-1)
        cos_tilt, cos_lean, cos_turn = torch.cos(angles).unbind(-1)
        # R = Rz(tilt) Rx(list) Ry(rotation) in axes x forward, y up, z right.
        back, rise = sin_tilt * cos_lean, cos_tilt * cos_lean
        # ω = ẑ tilt' + Rz x̂ list' + Rz Rx ŷ rotation', in the same axes; the world's are x, -z, y.
        spin_x = torch.addcmul(cos_tilt * leaning, back, turning, value=-1.0)
        spin_y = torch.addcmul(sin_tilt * leaning, rise, turning)
        spin_z = torch.addcmul(tilting, sin_lean, turning)
        return Root(
            height=height - self.ground_height(x),
            up=torch.stack((-back, -sin_lean, rise), dim=-1),
            heading=torch.addcmul(cos_tilt * cos_turn, sin_tilt * sin_lean, sin_turn, value=-1.0),
            place=torch.stack((x, -right), dim=-1),
            pose=state.qpos[:, 2:6],
            velocity=torch.stack((forward, -rightward, upward), dim=-1),
            spin=torch.stack((spin_x, -spin_z, spin_y), dim=-1),
        )
