"""The settings of MyoSuite's walking task."""

from typing import Literal

from pydantic import PositiveFloat

from msk_ray.config.physics import ACTIVATION, SOLVING, STEPPING
from msk_ray.config.sections import Count, EnvSettings, Fraction, NonNegative, Reward, Text
from msk_ray.legs.config import AssistConfig

FURTHER = ("height", "effort", "footfall", "clearance")
"""Weights of terms that MyoSuite does not have; they are there only where they are not zero."""


class MyoSuiteWalkReward(Reward):
    """MyoSuite's weights, under its names, where those of costs are negative; then costs with the weights of other
    legs, which are positive and which MyoSuite does not have."""

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
    height: NonNegative = 0.0
    """Weight of (drop of the centre of mass below its height in standing)² [1/m²]."""
    effort: NonNegative = 0.0
    """Weight of the mean squared activation."""
    footfall: NonNegative = 0.0
    """Weight of the speed of heel and toes while people have them on the ground, if their hips swing with the phase."""
    clearance: NonNegative = 0.0
    """Weight of ((clearance_height - height) / clearance_height)² of heel and toes below that height while people have
    the foot in the air."""
    clearance_height: PositiveFloat = 0.02
    """Height above their place in standing that feet should have in swing [m]."""


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
    cycle: Fraction = 0.0
    """Share of training's episodes that start elsewhere: anywhere in people's gait cycle, in their posture and with
    their speeds, at the phase at which the reward wants the hips like that. Scores are without them."""
    symmetric: bool = False
    """One half of the cycle is the mirror image of the other: while the phase is in its second half, right and left are
    exchanged in MyoSuite's observation before the policy sees it, with the phase half a turn back, and in its actions.
    It is part of the policy, in scores as in training. (Muscles of both sides differ by 1 %.)"""
    assist: AssistConfig = AssistConfig()
    smoothing: Fraction = 0.2
    """Width, in excitation, of the blend between activation and deactivation, which has no slope without it. Scores are
    taken with 0, MyoSuite's own hard switch."""
    reward: MyoSuiteWalkReward = MyoSuiteWalkReward()

    def check_installed(self) -> None:
        from msk_ray.legs.myosuite_walk.source import find_file  # loads MuJoCo

        find_file(self.model)

    def unread(self) -> dict[str, str]:
        unread = self.assist.unread()
        if self.reset != "random" and not self.cycle:
            fixed = f"env.reset {self.reset} starts every episode in the same state; write env.reset: random"
            unread["stochastic_reset"] = fixed
        if not self.stochastic_reset:
            unread["cycle"] = "env.stochastic_reset is false"
        if not self.reward.clearance:
            unread["reward.clearance_height"] = "env.reward.clearance is 0"
        return unread
