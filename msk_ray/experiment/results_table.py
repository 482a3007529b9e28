"""An experiment's results as tables, text and plain data."""

import statistics
import textwrap
from collections.abc import Sequence
from typing import Any

from msk_ray.experiment.records import TrialRecord, best_records, records_by_environment
from msk_ray.text import printable, printable_lines
from msk_ray.text_table import text_table

VARIANT_HEADER = ("variant", "seeds", "mean score", "std", "worst", "best")
HEADER = ("trial", "changed", "seed", "score", "at epoch", "epochs", "stopped", "path", "why")
_UNCUT = 1 << 20
"""Width of a table of which nothing is cut."""


def result_rows(records: Sequence[TrialRecord]) -> list[tuple[str, ...]]:
    """One row per trial of one environment, the highest score first."""
    ordered = sorted(records, key=lambda record: float("inf") if record.score is None else -record.score)
    return [_row(record) for record in ordered]


def variant_rows(records: Sequence[TrialRecord]) -> list[tuple[str, ...]]:
    """One row of texts per variant of one environment, highest mean first: number of seeds, and mean, standard
    deviation, minimum and maximum of their best scores."""
    groups: dict[str, list[TrialRecord]] = {}
    for record in records:
        groups.setdefault(record.trial.variant, []).append(record)
    rows = []
    for variant, group in groups.items():
        scored = [record for record in group if record.score is not None]
        scores = [record.score for record in scored if record.score is not None]
        if not scores:
            rows.append((float("-inf"), (variant, "0", "-", "-", "-", "-")))
            continue
        counts = {
            "before the end": sum(record.cut for record in scored),
            "with half the worlds": sum(record.attempt.reduction is not None for record in scored),
        }
        remarks = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
        seeds = f"{len(scores)} ({remarks})" if remarks else str(len(scores))
        mean = statistics.fmean(scores)
        deviation = f"{statistics.stdev(scores):.4g}" if len(scores) > 1 else "-"
        texts = (variant, seeds, f"{mean:.5g}", deviation, f"{min(scores):.5g}", f"{max(scores):.5g}")
        rows.append((mean, texts))
    return [texts for _, texts in sorted(rows, key=lambda row: -row[0])]


def results_text(records: Sequence[TrialRecord], width: int) -> str:
    """The trials of each environment, and its variants over seeds if there are several, as tables."""
    groups = records_by_environment(records)
    parts = []
    for environment, group in groups.items():
        table = text_table(HEADER, result_rows(group), width)
        parts.append(f"{printable(environment)}\n{table}" if len(groups) > 1 else table)
        if len({record.trial.seed for record in group}) > 1:
            parts.append(text_table(VARIANT_HEADER, variant_rows(group), width))
            if any(record.cut for record in group):
                parts.append(
                    "Trials that were interrupted or stopped before their end count with their best score so far, "
                    "which might have risen further: the report compares variants at equal env steps."
                )
    if (note := reduced_note(records)) is not None:
        parts.append(note)
    return "\n\n".join(parts)


def table_document(name: str, question: str, records: Sequence[TrialRecord]) -> str:
    """The results of an experiment as Markdown, indented, so that it is shown literally whatever it contains."""
    parts = [printable(name), printable_lines(question), results_text(records, _UNCUT)]
    return textwrap.indent("\n\n".join(filter(None, parts)), "    ") + "\n"


def summary(name: str, question: str, records: Sequence[TrialRecord]) -> dict[str, Any]:
    """Everything the tables show, as plain data. Paths are relative to the experiment's folder.

    `best` holds the best trial of each environment by its name.
    """
    return {
        "experiment": name,
        "question": question,
        "best": {environment: _facts(best) for environment, best in best_records(records).items()},
        "trials": [_facts(record) for record in records],
    }


def outcome_name(record: TrialRecord) -> str:
    """The outcome's name; `interrupted` or `waiting` for a trial without one."""
    if record.ending is not None:
        return str(record.ending.outcome)
    return "interrupted" if record.epochs_done else "waiting"


def reduced_note(records: Sequence[TrialRecord]) -> str | None:
    """A note for the reader of a table on trials with half their worlds; None if there are none."""
    count = sum(record.attempt.reduction is not None for record in records)
    if not count:
        return None
    trials = "1 trial" if count == 1 else f"{count} trials"
    return (
        f"{trials} ran with half the worlds asked for, after running out of memory with all of them: "
        "not comparable with the others."
    )


def _row(record: TrialRecord) -> tuple[str, ...]:
    trial, best = record.trial, record.best
    return (
        trial.id,
        trial.variant,
        str(trial.seed),
        "-" if best is None else f"{best.score:.5g}",
        "-" if best is None else str(best.epoch),
        f"{record.epochs_done}/{trial.epochs}",
        # Not after the reason, which a terminal may cut off.
        outcome_name(record) + record.attempt.mark,
        f"trials/{trial.id}",
        record.why,
    )


def _facts(record: TrialRecord) -> dict[str, Any]:
    best, reduction = record.best, record.attempt.reduction
    return {
        "id": record.trial.id,
        "environment": record.trial.environment,
        "changed": record.trial.changed,
        "values": record.trial.values,
        "seed": record.trial.seed,
        "score": None if best is None else best.score,
        "score_epoch": None if best is None else best.epoch,
        "epochs": record.epochs_done,
        "epochs_planned": record.trial.epochs,
        "seconds": record.seconds,
        "outcome": outcome_name(record),
        "why": record.ending.why if record.ending is not None else "",
        "halved": None if reduction is None else {"asked": reduction.asked, "worlds": reduction.worlds},
        "folder": f"trials/{record.trial.id}",
        "best_checkpoint": f"trials/{record.trial.id}/checkpoints/best.pt" if best and record.best_checkpoint else None,
    }
