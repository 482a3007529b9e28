"""Legged robots whose joints are turned by position servos, with mjlab's actions.

Axes: W worlds, J joints except the free one.
"""

from typing import ClassVar, Generic, TypeVar

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.mjcf.env import MjcfEnv
from msk_ray.envs.position_servos import position_servos
from msk_ray.errors import ConfigError
from msk_ray.robots.config import ServoSettings
from msk_ray.robots.mjcf_check import check_default_pose
from msk_ray.robots.robot import Robot
from msk_ray.step import StepState
from msk_ray.step.autograd.tangent import quat_conjugate, quat_rotate

AnyServoSettings = TypeVar("AnyServoSettings", bound=ServoSettings)

_TORQUE_SHARE = 0.25
"""Share of a servo's largest torque with which it starts towards the target of an mjlab action of 1."""
_LIMIT_SHARE = 0.9
"""Share of a joint's range, about its middle, outside which the term `dof_pos_limits` counts."""


def servos_of(model: mujoco.MjModel) -> list[int]:
    """Number of the position servo of each joint, J numbers in the order of the joints.

    Raises:
        ConfigError: the first joint is not free, another is not a hinge, or a hinge has no position servo with a force
            range.
    """
    kinds = [mujoco.mjtJoint(kind) for kind in model.jnt_type]
    if kinds[:1] != [mujoco.mjtJoint.mjJNT_FREE] or any(kind != mujoco.mjtJoint.mjJNT_HINGE for kind in kinds[1:]):
        raise ConfigError("a robot needs a model whose first joint is free and whose others are hinges")
    usable = position_servos(model) & (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT))
    usable &= model.actuator_forcerange[:, 1] > 0.0
    servo_of = {int(model.actuator_trnid[servo, 0]): int(servo) for servo in usable.nonzero()[0]}
    for joint in range(1, model.njnt):
        if joint not in servo_of:
            name = model.joint(joint).name
            raise ConfigError(
                f"joint {name!r} needs a position servo with a force range, such as "
                f'<position joint="{name}" kp="50" kv="2" forcerange="-40 40"/>'
            )
    return [servo_of[joint] for joint in range(1, model.njnt)]


def action_scale_of(model: mujoco.MjModel) -> NDArray[np.float64]:
    """Angle by which an mjlab action of 1 moves the target of each joint [rad], (J,).

    Raises:
        ConfigError: as for `servos_of`.
    """
    servos = servos_of(model)
    scale: NDArray[np.float64] = (
        _TORQUE_SHARE * model.actuator_forcerange[servos, 1] / model.actuator_gainprm[servos, 0]
    )
    return scale


class ServoEnv(MjcfEnv[AnyServoSettings], Generic[AnyServoSettings]):
    """A robot whose actions turn the targets of its servos away from the default pose.

    The MJCF has one free joint, which comes first, J hinges with a position servo each, and a keyframe with the default
    pose. Actions and joints are in the order of the MJCF's joints, not in that of its actuators.
    """

    Settings = ServoSettings
    robot: ClassVar[Robot]

    def prepare(self) -> None:
        model = self.model
        self.joint_names = [model.joint(joint).name for joint in range(1, model.njnt)]
        check_default_pose(type(self).__qualname__, model, self._start.qpos[0].tolist() if model.nkey else None)
        self.default_pose = self._start.qpos[0, 7:]
        self.action_scale = self.tensor(action_scale_of(model))
        self.action_size = len(self.action_scale)
        self._joint_of_servo = torch.tensor(
            [int(joint) - 1 for joint in model.actuator_trnid[:, 0]], device=self.device
        )
        low, high = model.jnt_range[1:].T
        middle, half = (low + high) / 2.0, _LIMIT_SHARE * (high - low) / 2.0
        self.joint_limits = self.tensor(middle - half), self.tensor(middle + half)
        self._down = self.tensor([0.0, 0.0, -1.0])

    @classmethod
    def edit(cls, spec: mujoco.MjSpec, config: AnyServoSettings, physics: PhysicsConfig) -> None:
        """Let the solver converge, which gradients need; mjlab stops it after 10 iterations."""
        if physics.iterations is None:
            spec.option.iterations = max(spec.option.iterations, 100)
        if physics.ls_iterations is None:
            spec.option.ls_iterations = max(spec.option.ls_iterations, 50)

    def gravity_in(self, state: StepState, body: str) -> Tensor:
        """Direction of gravity in the axes of a body, (W, 3)."""
        orientation = self.frames(state).orientation(body)
        return quat_rotate(quat_conjugate(orientation), self._down.expand(self.nworld, 3))

    def mjlab_action(self, action: Tensor) -> Tensor:
        """A policy's action in mjlab's units, both (W, J)."""
        return self.config.action_range * action

    def control(self, action: Tensor) -> Tensor:
        """Targets of the servos [rad]: the default pose + `action_scale` × mjlab's action."""
        target = self.default_pose + self.action_scale * self.mjlab_action(action)
        return target[:, self._joint_of_servo]

    def action_names(self) -> list[str]:
        return self.joint_names
