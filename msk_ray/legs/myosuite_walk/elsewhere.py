"""`evaluate --in myosuite`, as an entry point declares it; read before torch is loaded."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from msk_ray.evaluate.elsewhere import Scorer
    from msk_ray.evaluate.measure import Request


class MyoSuiteScoring:
    """MyoSuite's own walking task."""

    summary = (
        "myosuite: a policy of env myosuite_walk in the unmodified CPU environment of MyoSuite 2.12, 20 episodes with "
        "its own resets and 20 with random ones"
    )
    python = Path(".myosuite/bin/python")
    install = (
        "install MyoSuite beside msk_ray: python -m venv .myosuite && .myosuite/bin/pip install myosuite==2.12.2, then "
        f"--python {python}"
    )

    def scorer(self, python: Path) -> "Scorer":
        """The scorer that runs in this interpreter."""
        from msk_ray.legs.myosuite_walk.scoring import MyoSuiteScorer

        return MyoSuiteScorer(python)

    def requests(self, worlds: int | None, seeds: tuple[int, ...] | None, steps: int | None) -> "Sequence[Request]":
        """One request for each kind of reset; see `scoring.requests`."""
        from msk_ray.legs.myosuite_walk.scoring import requests

        return requests(worlds, seeds, steps)


MYOSUITE = MyoSuiteScoring()
