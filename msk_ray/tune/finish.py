"""The results at the end of an experiment: a table on the terminal, summary.json, table.md, and the report."""

import shutil
import subprocess
import sys

from msk_ray.cli import shell_join
from msk_ray.experiment.damage import count_damages, describe_damages
from msk_ray.experiment.layout import SUMMARY_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.records import best_records, read_records
from msk_ray.experiment.results_table import results_text, summary, table_document
from msk_ray.files import write_json, write_text
from msk_ray.progress import announce
from msk_ray.text import printable


def finish(experiment: Experiment) -> int:
    """Write and print the results on disk.

    Returns:
        Number of trials that ended in an error.

    Raises:
        StorageFailure: the disk is full or gone, or the experiment has disappeared.
    """
    experiment.check_there()
    question = experiment.manifest().get("question") or ""
    records = read_records(experiment)
    width = max(100, shutil.get_terminal_size((160, 24)).columns)
    write_json(experiment.path / SUMMARY_FILE, summary(experiment.name, question, records))
    write_text(experiment.path / "table.md", table_document(experiment.name, question, records))
    print("\n" + results_text(records, width))
    damages = [damage for record in records for damage in record.damages]
    if damages:
        print(f"\nskipped {count_damages(damages)}:")
        print("\n".join(describe_damages(damages, experiment.path)))
    several = len({record.trial.environment for record in records}) > 1
    for environment, best in best_records(records).items():
        where = f" in {environment}" if several else ""
        name = f"{best.trial.variant} seed={best.trial.seed}{best.attempt.suffix}{where}"
        print(f"\nbest trial   {best.trial.id}: {printable(name)}, score {best.score:.5g}")
        print(f"best policy  {printable(str(best.best_checkpoint or 'its checkpoint is missing'))}")
    print(printable(f"table        {experiment.path / 'table.md'}"))
    print(printable(f"trials       {experiment.path / 'trials'}"), flush=True)
    return sum(record.errored for record in records)


def write_report(experiment: Experiment) -> None:
    """Run `python -m msk_ray.report`, which writes the experiment's page and prints its path.

    A separate process, because the report draws with OpenGL and simulates the best policy, and its failure must not
    affect the results above.
    """
    announce("writing the report")
    command = [sys.executable, "-m", "msk_ray.report", str(experiment.path)]
    code = subprocess.run(command).returncode
    if code:
        words = ["python", "-m", "msk_ray.report", experiment.name, "--storage", str(experiment.path.parent)]
        print(f"no report (exit code {code}); to try again: {shell_join(words)}", flush=True)
