"""The motion of the recorded steps of mjlab's tracking task."""

from pathlib import Path

from msk_ray.config import PhysicsConfig
from msk_ray.robots.tracking.config import G1TrackingSettings
from msk_ray.robots.tracking.env import G1Tracking
from msk_ray.robots.tracking.motions import Clip, read_motions

CUT = (0.0, 1.2)
"""Part of `builtin:squat` that was followed [s]."""


def write_recorded_motion(path: Path) -> None:
    """Write the motion for `tests/fixtures/mjlab/record_tracking.py`."""
    model = G1Tracking.build_model(G1TrackingSettings(name="g1_tracking"), PhysicsConfig())
    (motion,) = read_motions("builtin:squat", model)
    Clip.of(motion.at_rate(50.0).cut(*CUT), model).save(path)
