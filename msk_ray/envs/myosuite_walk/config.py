"""The settings of MyoSuite's walking task."""

from typing import Literal

from pydantic import PositiveFloat

from msk_ray.config.physics import ACTIVATION, SOLVING, STEPPING
from msk_ray.config.sections import Count, EnvSettings, Fraction, Reward, Text


class MyoSuiteWalkReward(Reward):
    """MyoSuite's weights, under its names; those of costs are negative."""

    vel_reward: float = 5.0
    """Weight of exp(−(1.2 m/s − v)²) + exp(−u²), where v is the velocity forward and u that to the side [m/s]."""
    cyclic_hip: float = -10.0
    """Weight of the distance between the flexion of both hips and 0.8 cos(φ + π) (left), 0.8 cos φ (right) [1/rad],
    where φ makes a turn in 100 env steps."""
    ref_rot: float = 10.0
    """Weight of exp(−5 d), where d is the distance between the quaternion of the root and that of standing."""
    joint_angle_rew: float = 5.0
    """Weight of exp(−5 m), where m is the mean size of both hips' adduction and rotation [rad]."""
    done: float = -100.0
    """Reward for the step in which it falls."""


class MyoSuiteWalkSettings(EnvSettings):
    """MyoSuite's `myoLegWalk-v0`, with settings that make it easier to learn; scores are without them."""

    reads_physics = STEPPING | SOLVING | ACTIVATION

    episode_length: Count = 1000
    control_timestep: PositiveFloat = 0.01
    model: Text | None = None
    """Path of MyoSuite 2.12's `myolegs.xml`; null: that of the installed package."""
    reset: Literal["init", "random", "none"] = "init"
    """Initial states, as MyoSuite's `reset_type`: one fixed state in mid-stride (`init`), that or its mirror image with
    noise of 0.02 on every coordinate except the height (`random`), or standing (`none`)."""
    smoothing: Fraction = 0.2
    """Width, in excitation, of the blend between activation and deactivation, which has no slope without it. Scores are
    taken with 0, MyoSuite's own hard switch."""
    reward: MyoSuiteWalkReward = MyoSuiteWalkReward()

    def unread(self) -> dict[str, str]:
        fixed = f"env.reset {self.reset} starts every episode in the same state; write env.reset: random"
        return {} if self.reset == "random" else {"stochastic_reset": fixed}
