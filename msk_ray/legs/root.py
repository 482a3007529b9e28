"""Where the pelvis is and how it moves. W worlds."""

from typing import NamedTuple

from torch import Tensor


class Root(NamedTuple):
    """The pelvis in the world, each (W,) or (W, k), world frame: x forward, y left, z up."""

    height: Tensor
    """Height above the ground [m]."""
    up: Tensor
    """The trunk's up axis, (W, 3)."""
    heading: Tensor
    """Cosine between the pelvis's forward axis and +x."""
    place: Tensor
    """Forward and to the left of the start [m], (W, 2)."""
    pose: Tensor
    """Position and orientation in the observation (W, k)."""
    velocity: Tensor
    """Velocity [m/s], (W, 3)."""
    spin: Tensor
    """Angular velocity [rad/s], (W, 3)."""
