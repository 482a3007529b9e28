"""What the early-stopping rule was told, in the order it was told: fed with it again, the rule is where it was.

Trials' own records do not tell the order between trials, nor which of their last rows the driver had heard of when it
died; and a rule that is told an evaluation twice judges it twice, the second time against more trials.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from msk_ray.errors import StorageFailure
from msk_ray.files import write_text
from msk_ray.tune.outcomes import Ending
from msk_ray.tune.pruning import Pruner
from msk_ray.tune.stopping import Evaluation

JOURNAL_FILE = "reports.jsonl"


@dataclass(frozen=True)
class Report:
    """One evaluation as the driver heard of it."""

    trial: str
    epoch: int
    env_steps: int
    seconds: float
    score: float
    ended: bool
    """Whether the trial had ended by itself."""
    halved: bool = False
    """Whether it ran with half its worlds; what it reported with all of them no longer counts then."""

    def time(self, attribute: str) -> float:
        """Progress as `env_steps`, `epoch` or `seconds`."""
        return Evaluation(self.epoch, self.env_steps, self.seconds, self.score).time(attribute)


class Journal:
    """The reports of an experiment, one JSON object a line."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> list[Report]:
        """All reports; a last line torn by the driver's death is cut off."""
        if not self._path.is_file():
            return []
        text = self._path.read_text(encoding="utf-8")
        whole, _, torn = text.rpartition("\n")
        if torn:
            write_text(self._path, whole + "\n" if whole else "")
        return [Report(**json.loads(line)) for line in whole.splitlines()]

    def append(self, report: Report) -> None:
        """Add one report; it outlives this process when this returns.

        Raises:
            StorageFailure: the disk is full or gone.
        """
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(report)) + "\n")
        except OSError as error:
            raise StorageFailure(f"cannot write {self._path}: {error.strerror or error}") from error


def replay(pruner: Pruner, time_attr: str, reports: Sequence[Report]) -> Ending | None:
    """Feed a rule with recorded reports, but for those of untrained policies, which older versions recorded.

    Returns:
        What it answered to the last one, which the driver may not have lived to carry out.
    """
    ending = None
    halved: set[str] = set()
    for report in reports:
        if report.halved and report.trial not in halved:
            halved.add(report.trial)
            pruner.forget(report.trial)
        ending = pruner.report(report.trial, report.time(time_attr), report.score) if report.epoch > 0 else None
    return None if not reports or reports[-1].ended else ending
