"""`evaluate --in NAME`: evaluation in another package's environment, which runs in its own Python.

A package declares one in the entry-point group `msk_ray.scoring`. Imports no torch: the command line reads it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
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


class ForeignScorer(Scorer, Protocol):
    """Evaluates policies in another package's environment."""

    def requests(self, worlds: int | None, seeds: tuple[int, ...] | None, steps: int | None) -> "Sequence[Request]":
        """Requests with these numbers of worlds, seeds and steps; None: the number that is usual there.

        Raises:
            ConfigError: it does not support one of the numbers.
        """


@dataclass(frozen=True)
class ForeignScoring:
    """Another package in which policies can be evaluated. An entry point in the group `msk_ray.scoring` names one."""

    name: str
    """Name for `--in`, for the installed package, and for the folder of its virtual environment."""
    package: str
    """Name of the package in sentences."""
    version: str
    """Version of the package that has these environments, without its last number."""
    requirement: str
    """The package as pip takes it."""
    summary: str
    """A line for `--help`: which policies are evaluated, and in which environment."""
    scorer_class: str
    """Import path of a `ForeignScorer` whose constructor takes the path of an interpreter."""

    @property
    def python(self) -> Path:
        """Path of the package's interpreter, unless `--python` names another one."""
        return Path(f".{self.name}/bin/python")

    @property
    def install(self) -> str:
        """How a user installs the package, as part of an error message."""
        return (
            f"install {self.package} beside msk_ray: python -m venv .{self.name} && .{self.name}/bin/pip install "
            f"{self.requirement}, then --python {self.python}"
        )

    def scorer(self, python: Path) -> ForeignScorer:
        """The scorer that runs in this interpreter."""
        scorer: ForeignScorer = resolve(self.scorer_class, "--in")(python)
        return scorer


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
