"""The settings of MyoSuite's walking task."""

from typing import Literal

from pydantic import PositiveFloat

from msk_ray.config.physics import ACTIVATION, SOLVING, STEPPING
from msk_ray.config.rewards import reward_section, with_reward
from msk_ray.config.sections import Count, EnvSettings, Fraction, Reward, Text
from msk_ray.config.terms import Cost, Term, terms_in
from msk_ray.legs.config import AssistConfig


class MyoSuiteWalkShape(Reward):
    """The settings of terms other than their weights."""

    clearance_height: PositiveFloat = 0.02
    """Height above their place in standing that feet should have in swing [m]."""


TERMS = terms_in(
    "msk_ray.legs.myosuite_walk.terms",
    # MyoSuite's weights, under its names.
    Term("vel_reward", 5.0),
    Term("cyclic_hip", -10.0),
    Term("ref_rot", 10.0),
    Term("joint_angle_rew", 5.0),
    Term("done", -100.0, gradient=False),
    # Costs that MyoSuite does not have.
    Cost("height", 0.0, optional=True),
    Cost("effort", 0.0, optional=True),
    Cost("footfall", 0.0, optional=True),
    Cost("clearance", 0.0, needs=("reward.clearance_height",), optional=True),
)
MyoSuiteWalkReward = reward_section("MyoSuiteWalkReward", __name__, TERMS, MyoSuiteWalkShape)


@with_reward(MyoSuiteWalkReward)
class MyoSuiteWalkSettings(EnvSettings):
    """Legs with 80 muscles walk in MyoSuite's `myoLegWalk-v0`.

    Settings that make it easier to learn are for training; scores are without them.
    """

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
    reward: MyoSuiteWalkShape = MyoSuiteWalkShape()

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
        return unread
