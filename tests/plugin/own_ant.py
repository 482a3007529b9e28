"""An ant that should not turn about the vertical while it runs."""

from msk_ray import Term
from msk_ray.envs.ant.env import Ant


def spin(env, state, action, obs):
    """Squared angular velocity of the torso about its own up axis [rad²/s²], one number for each world."""
    return state.qvel[:, 5].square()


class MyAnt(Ant):
    terms = (*Ant.terms, Term("spin", -0.1, spin))
