"""`evaluate --in mjlab`, as an entry point declares it; read before torch is loaded."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from msk_ray.evaluate.elsewhere import Scorer
    from msk_ray.evaluate.measure import Request


class MjlabScoring:
    """mjlab's own velocity tasks."""

    summary = (
        "mjlab: a policy of go1_velocity, go1_velocity_rough or g1_velocity in mjlab 1.6's own task, with its settings "
        "for playing, and then with training's pushes and noise; 256 episodes of 20 s on a GPU, 8 on a CPU"
    )
    python = Path(".mjlab/bin/python")
    install = (
        "install mjlab beside msk_ray: python -m venv .mjlab && .mjlab/bin/pip install mjlab==1.6.0, then "
        f"--python {python}"
    )

    def scorer(self, python: Path) -> "Scorer":
        """The scorer that runs in this interpreter."""
        from msk_ray.robots.mjlab.scoring import MjlabScorer

        return MjlabScorer(python)

    def requests(self, worlds: int | None, seeds: tuple[int, ...] | None, steps: int | None) -> "Sequence[Request]":
        """One request with mjlab's settings for playing, and one with pushes and noise; see `scoring.requests`."""
        from msk_ray.robots.mjlab.scoring import requests

        return requests(worlds, seeds, steps)


MJLAB = MjlabScoring()
