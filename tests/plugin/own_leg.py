"""A reward term of one's own for the legs of 26 muscles: a cost of bouncing."""

from torch import Tensor

from msk_ray import Cost, StepState
from msk_ray.legs.myoleg26.env import MyoLeg26


def bounce(env: MyoLeg26, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
    """The pelvis's squared vertical velocity [m²/s²]."""
    return env.root(state).velocity[:, 2].square()


class SmoothLegs(MyoLeg26):
    """Legs that should not bounce."""

    terms = (*MyoLeg26.terms, Cost("bounce", 0.5, bounce))
