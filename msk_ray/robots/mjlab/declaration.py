"""`evaluate --in mjlab`, as an entry point declares it. Imports no torch: the command line reads it."""

from msk_ray.evaluate.foreign_scoring import ForeignScoring

MJLAB = ForeignScoring(
    name="mjlab",
    package="mjlab",
    version="1.6",
    requirement="mjlab==1.6.0",
    summary="mjlab: a policy of go1_velocity, go1_velocity_rough, g1_velocity or g1_tracking (one clip) in mjlab 1.6's "
    "own task, first with its settings for playing, then also with the pushes and noise of its training; 256 episodes "
    "of 20 s on a GPU, 8 on a CPU",
    scorer_class="msk_ray.robots.mjlab.scoring:MjlabScorer",
)
