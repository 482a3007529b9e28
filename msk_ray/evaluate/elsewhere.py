"""`evaluate --in NAME`: scoring in another package's environment, which has an interpreter of its own.

A package declares one in the entry-point group `msk_ray.scoring`. Imports no torch: the command line reads it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from msk_ray.errors import ConfigError
from msk_ray.registry import Registry, resolve

if TYPE_CHECKING:
    from msk_ray.config import Config
    from msk_ray.evaluate.measure import Request
    from msk_ray.training import SavedPolicy

SCORINGS = Registry("--in", "msk_ray.scoring", {})
"""Environments of other packages in which policies can be scored, by name."""


class Scorer(Protocol):
    """Evaluates policies, here or elsewhere."""

    def check(self, config: "Config", request: "Request") -> None:
        """Raise ConfigError if a trial's policy cannot be evaluated as requested. Runs nothing."""

    def evaluate(self, policy: "SavedPolicy", request: "Request") -> dict[str, Any]:
        """One entry of `eval.json`: what was evaluated, how, and the results."""


class ForeignScoring(Protocol):
    """An entry point in the group `msk_ray.scoring` names an object with these members."""

    summary: str
    """For `--help`: which policies it evaluates, and in which environment."""
    python: Path
    """Path of its interpreter, unless `--python` names another."""
    install: str
    """How a user installs it."""

    def scorer(self, python: Path) -> Scorer:
        """The scorer that runs in this interpreter."""

    def requests(self, worlds: int | None, seeds: tuple[int, ...] | None, steps: int | None) -> "Sequence[Request]":
        """Requests for these numbers of worlds, seeds and steps; None: as is usual there.

        Raises:
            ConfigError: it does not support one of the numbers.
        """


def foreign_scoring(name: str) -> ForeignScoring:
    """The scoring of this name.

    Raises:
        ConfigError: there is none.
    """
    scoring: ForeignScoring = resolve(SCORINGS.path(name), "--in")
    return scoring


def find_python(scoring: ForeignScoring, path: Path | None) -> Path:
    """The interpreter at `path`, or the scoring's own.

    Raises:
        ConfigError: there is no such file.
    """
    path = path or scoring.python
    if not path.is_file():
        raise ConfigError(f"--python: no file {path}; {scoring.install}")
    return path
