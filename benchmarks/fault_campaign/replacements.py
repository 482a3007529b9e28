"""SIGKILL inside every replacement of a file: what lies there is the old one or the new one, whole."""

import json
import random
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fault_campaign.killed import calls_of, die_within
from fault_campaign.reference import Reference
from fault_campaign.tally import Tally
from msk_ray.experiment import layout
from msk_ray.experiment.attempts import Attempt, WorldReduction, load_attempt
from msk_ray.experiment.checkpoint_format import read_checkpoint_file, write_checkpoint_file
from msk_ray.experiment.evaluation_log import EvaluationLog, LogEntry
from msk_ray.experiment.metrics import load_metrics
from msk_ray.experiment.outcomes import Ending, Outcome, load_ending, write_ending
from msk_ray.files import write_json, write_text
from msk_ray.training.loggers.jsonl import JsonLines

KILLS = 30
"""Of each kind of file, where it has as many places."""
_FIRST_CALLS = 80
"""Places lie among the first C calls of a writer: what comes later, such as TensorBoard's, is not about the file."""


@dataclass(frozen=True)
class Writer:
    """How a file is written, and what may be found after its writer was killed."""

    name: str
    prepare: Callable[[Path], object]
    write: Callable[[Path], object]
    read: Callable[[Path], Any]
    best: bool = False
    """Whether it holds the best policy."""


def replacements(reference: Reference, scratch: Path, rng: random.Random) -> list[Tally]:
    """A real process, killed at chosen places inside the writers that trials and drivers use."""
    checkpoints = reference.folder_of(reference.trials[0]) / "checkpoints"
    old = read_checkpoint_file(min(checkpoints.glob("policy_*.pt")))[1]
    new = read_checkpoint_file(max(checkpoints.glob("epoch_*.pt")))[1]
    tallies = []
    for writer in _writers(old, new):
        started = time.monotonic()
        folder = scratch / "replacements"
        tally = Tally(f"SIGKILL inside the writer of {writer.name}", 0, "nothing")

        def fresh(folder: Path = folder, writer: Writer = writer) -> None:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            writer.prepare(folder)

        def write(folder: Path = folder, writer: Writer = writer) -> None:
            writer.write(folder)

        fresh()
        before = writer.read(folder)
        places = min(calls_of(write), _FIRST_CALLS)
        fresh()
        writer.write(folder)
        after = writer.read(folder)
        assert before != after
        for place in sorted(rng.sample(range(1, places + 1), min(KILLS, places))):
            fresh()
            if not die_within(write, place):
                continue
            tally.injected += 1
            try:
                found = writer.read(folder)
            except Exception as error:  # whatever it is: the file is lost
                found = error
            if found not in (before, after):
                tally.lost_rows += not writer.best
                tally.lost_policies += writer.best
                tally.notes.append(f"killed before call {place}: {found!s:.200}")
        tally.seconds = time.monotonic() - started
        shutil.rmtree(folder)
        tallies.append(tally)
    return tallies


def _writers(old: bytes, new: bytes) -> list[Writer]:
    rows = [{"epoch": epoch, "env_steps": 8.0 * epoch, "seconds": 0.5 * epoch} for epoch in range(3)]
    reports = [LogEntry("a", epoch, 8 * epoch, 0.5 * epoch, 1.0, False) for epoch in range(3)]
    text = json.dumps({"trials": ["x" * 1000] * 4})

    def checkpoint(name: str) -> Writer:
        return Writer(
            name,
            lambda f: write_checkpoint_file(f / name, old, {"epoch": 0, "best_score": 1.0}),
            lambda f: write_checkpoint_file(f / name, new, {"epoch": 40, "best_score": 2.0}),
            lambda f: read_checkpoint_file(f / name),
            best=True,
        )

    def plain(name: str) -> Writer:
        return Writer(
            name,
            lambda f: write_json(f / name, {"trials": []}),
            lambda f: write_text(f / name, text),
            lambda f: json.loads((f / name).read_text()),
        )

    def log(folder: Path, some: list[dict[str, float]]) -> None:
        metrics = JsonLines(folder)
        for row in some:
            metrics.write(row)

    def journal(folder: Path, some: list[LogEntry]) -> None:
        for report in some:
            EvaluationLog(folder / layout.EVALUATION_LOG_FILE).append(report)

    return [
        checkpoint("best.pt"),
        checkpoint("epoch_000040.pt"),
        checkpoint("policy_000040.pt"),
        plain(layout.MANIFEST_FILE),
        plain(layout.SUMMARY_FILE),
        Writer(
            "table.md",
            lambda f: write_text(f / "table.md", "# old"),
            lambda f: write_text(f / "table.md", text),
            lambda f: (f / "table.md").read_text(),
        ),
        Writer(
            layout.OUTCOME_FILE,
            lambda f: write_ending(f, Ending(Outcome.WALL_TIME, "old")),
            lambda f: write_ending(f, Ending(Outcome.FINISHED, "new")),
            load_ending,
        ),
        Writer(
            layout.ATTEMPT_FILE,
            lambda f: Attempt(WorldReduction(8, 4, "old")).write(f),
            lambda f: Attempt(WorldReduction(8, 4, "old", cleared=True)).write(f),
            load_attempt,
        ),
        Writer(
            f"{layout.METRICS_FILE}, a row added",
            lambda f: log(f, rows[:2]),
            lambda f: log(f, rows[2:]),
            lambda f: load_metrics(f / layout.METRICS_FILE).rows,
        ),
        Writer(
            f"{layout.METRICS_FILE}, rows taken back",
            lambda f: log(f, rows),
            lambda f: JsonLines(f).rewind(1),
            lambda f: load_metrics(f / layout.METRICS_FILE).rows,
        ),
        Writer(
            f"{layout.EVALUATION_LOG_FILE}, a report added",
            lambda f: journal(f, reports[:2]),
            lambda f: journal(f, reports[2:]),
            lambda f: EvaluationLog(f / layout.EVALUATION_LOG_FILE).read(),
        ),
    ]
