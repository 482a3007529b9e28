"""`myoleg` standing or walking the way its toes point."""

import logging

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.layout import Entry, entries
from msk_ray.legs.assistance import FreeSprings, in_root
from msk_ray.legs.env import LegEnv
from msk_ray.legs.gait.body import world_axes
from msk_ray.legs.muscles import columns
from msk_ray.legs.myoleg.config import MyoLegSettings
from msk_ray.legs.myoleg.model import Couplings, build_myoleg, cycle_states, ground_height
from msk_ray.legs.myoleg.source import find_model
from msk_ray.legs.root import Root
from msk_ray.step import StepState
from msk_ray.step.autograd.tangent import quat_rotate

_START_ACTIVATION = 0.05
_log = logging.getLogger(__name__)


class MyoLeg(LegEnv[MyoLegSettings]):
    """The pose of the pelvis in the observation (7): its position to the left of its line [m], its forward axis and its
    up axis (3 each) in the world.

    Forward, left and up are the frame in which the model stands: these models walk along -y of MuJoCo's world. The
    forward axis is found from heel to toes, the up axis from gravity.
    """

    Settings = MyoLegSettings
    pose_signs = (-1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0)

    @classmethod
    def build_model(cls, config: MyoLegSettings, physics: PhysicsConfig) -> mujoco.MjModel:
        _log.info(find_model(config.model, config.source).describe())
        return build_myoleg(config, physics)

    def prepare_model(self) -> None:
        model = self.model
        couplings = Couplings(model)
        hinge = mujoco.mjtJoint.mjJNT_HINGE
        self.hinges = [
            j
            for j in range(model.njnt)
            if model.jnt_type[j] == hinge and model.jnt_limited[j] and j not in couplings.joints
        ]
        stand = model.key("stand").qpos
        self._ground = ground_height(model)
        self.stand_height = float(stand[2]) - self._ground
        axes = world_axes(model)

        self._axes, self._local = self.tensor(axes), self.tensor(in_root(model, axes))
        self._stand = self.tensor(stand)
        self._ranges = tuple(self.tensor(bound) for bound in model.jnt_range[self.hinges].T)
        self._dependent, self._driving = (
            columns(couplings.dependent, self.device),
            columns(couplings.driving, self.device),
        )
        self._dependent_dofs = columns(couplings.dependent_dofs, self.device)
        self._driving_dofs = columns(couplings.driving_dofs, self.device)
        self._reference, self._driving_reference = (
            self.tensor(couplings.reference),
            self.tensor(couplings.driving_reference),
        )
        self._coefficients = self.tensor(couplings.coefficients)

        if self.config.reset == "cycle":
            self._cycle = tuple(map(self.tensor, cycle_states(model, swaying=True)))
        self._springs = FreeSprings(model, axes, self.device)

    def applied_force(self, state: StepState) -> Tensor | None:
        return self.assistance.share * self._springs.force(state) if self.config.assist.epochs else None

    def draw_physics(self, count: int) -> StepState:
        return self._near(self._stand.repeat(count, 1), torch.zeros((count, self.model.nv), device=self.device))

    def draw_phase(self, phase: Tensor, speed: Tensor) -> StepState:
        if self.config.reset != "cycle":
            return super().draw_phase(phase, speed)
        count = len(self._cycle[0])
        qpos, qvel = (part[(phase * count).round().long() % count].clone() for part in self._cycle)
        qvel *= self.reference.pace.strides_per_second(speed)[:, None]
        qvel[:, :3] += speed[:, None] * self._axes[0]
        return self._near(qpos, qvel)

    def _near(self, qpos: Tensor, qvel: Tensor) -> StepState:
        """These initial states with noise."""
        noise, count = self.config.reset_noise, len(qpos)
        angles = qpos[:, self.hinge_qpos] + noise * self.uniform(count, len(self.hinges))
        qpos[:, self.hinge_qpos] = angles.clamp(*self._ranges)
        qpos[:, 2] += 0.2 * noise * (1.0 + self.uniform(count, 1)[:, 0])
        qvel[:, self._hinge_dofs] += 10.0 * noise * self.uniform(count, len(self.hinges))
        # Coupled joints follow those they are coupled to, in position and velocity.
        offset = qpos[:, self._driving] - self._driving_reference
        c = self._coefficients
        powers = torch.stack([offset**k for k in range(5)], dim=-1)
        slopes = torch.stack([k * offset ** max(k - 1, 0) for k in range(5)], dim=-1)
        qpos[:, self._dependent] = self._reference + (c * powers).sum(-1)
        qvel[:, self._dependent_dofs] = (c * slopes).sum(-1) * qvel[:, self._driving_dofs]
        act = torch.full((count, self.model.na), _START_ACTIVATION, device=self.device)
        return StepState(qpos, qvel, act)

    def people_poses(self) -> NDArray[np.float64]:
        return cycle_states(self.model)[0]

    def pose_layout(self) -> list[Entry]:
        axes = (f"pelvis_{axis}_axis_{part}" for axis in ("forward", "up") for part in ("forward", "left", "up"))
        return [Entry("pelvis_left_of_line", "m"), *entries(axes)]

    def measure_root(self, state: StepState) -> Root:
        q, v = state.qpos, state.qvel
        orientation = q[:, 3:7]
        # Rows of `_axes` are forward, left and up of the world.
        forward = quat_rotate(orientation, self._local[0].expand(len(q), 3)) @ self._axes.T
        up = quat_rotate(orientation, self._local[2].expand(len(q), 3)) @ self._axes.T
        spin = quat_rotate(orientation, v[:, 3:6]) @ self._axes.T  # MuJoCo's is in the body frame
        place = q[:, :3] @ self._axes.T
        return Root(
            height=q[:, 2] - self._ground,
            up=up,
            heading=forward[:, 0],
            place=place[:, :2],
            pose=torch.cat((place[:, 1:2], forward, up), dim=-1),
            velocity=v[:, :3] @ self._axes.T,
            spin=spin,
        )
