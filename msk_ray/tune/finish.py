"""The results at the end of an experiment: a table on the terminal, summary.json, table.md, and the report."""

import shlex
import shutil
import subprocess
import sys

from msk_ray.experiment.damage import count_damages, describe_damages
from msk_ray.experiment.layout import SUMMARY_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.results import best_record, read_records
from msk_ray.experiment.results_table import HEADER, reduced_note, result_rows, summary, table_document, variant_rows
from msk_ray.files import write_json, write_text
from msk_ray.progress import announce
from msk_ray.text import printable
from msk_ray.text_table import text_table


def finish(experiment: Experiment) -> int:
    """Write and print the results that are on disk.

    Returns:
        How many trials ended in an error.

    Raises:
        StorageFailure: the disk is full or gone, or the experiment has disappeared.
    """
    experiment.check_there()
    manifest = experiment.manifest()
    records = read_records(experiment)
    width = max(100, shutil.get_terminal_size((160, 24)).columns)
    write_json(experiment.path / SUMMARY_FILE, summary(experiment.name, manifest.get("question") or "", records))
    write_text(experiment.path / "table.md", table_document(experiment.path, manifest.get("question") or "", records))
    print("\n" + text_table(HEADER, result_rows(records), width))
    if len({record.trial.seed for record in records}) > 1:
        header = ("variant", "seeds", "mean score", "std", "min", "max")
        print("\n" + text_table(header, variant_rows(records), width))
    damages = [damage for record in records for damage in record.snapshot.damages]
    if damages:
        print(f"\nskipped {count_damages(damages)}:")
        print("\n".join(describe_damages(damages, experiment.path)))
    if (note := reduced_note(records)) is not None:
        print(f"\n{note}")
    best = best_record(records)
    if best is not None and best.best is not None:
        name = f"{best.trial.variant} seed={best.trial.seed}{best.attempt.suffix}"
        print(f"\nbest trial   {best.trial.id}: {printable(name)}, score {best.best.score:.5g}")
        print(f"best policy  {printable(str(best.best_checkpoint or 'its checkpoint is missing'))}")
    print(printable(f"table        {experiment.path / 'table.md'}"))
    print(printable(f"trials       {experiment.path / 'trials'}"), flush=True)
    return sum(record.errored for record in records)


def write_report(experiment: Experiment) -> None:
    """Have `python -m msk_ray.report` write the experiment's page and print its path.

    It runs in a separate process, because it draws with OpenGL and simulates the best policy, and a failure there must
    not affect the results above.
    """
    announce("writing the report")
    command = [sys.executable, "-m", "msk_ray.report", str(experiment.path)]
    code = subprocess.run(command).returncode
    if code:
        again = shlex.join(
            ["python", "-m", "msk_ray.report", experiment.name, "--storage", str(experiment.path.parent)]
        )
        print(printable(f"no report (exit code {code}); to try again: {again}"), flush=True)
