"""`python -m msk_ray.report`: the results of an experiment on one page, read from its files."""

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from msk_ray.cli import STORAGE, Parser, run
from msk_ray.errors import ConfigError
from msk_ray.evaluate.targets import find_experiment
from msk_ray.files import make_folder, write_text
from msk_ray.report.best import Best, look_at_best
from msk_ray.report.page import PAGE, command_of, compare, make_section, places_of, render_page
from msk_ray.report.reading import Condition, Reading, check_folder, read_experiment
from msk_ray.text import printable

DESCRIPTION = """\
Write one self-contained page about an experiment, or several side by side: learning curves, the ablation table with
confidence intervals, the effect of each parameter, which trial stopped when and why, gradient health, failures by
outcome, the best policy with its evaluation and film strip, and the command that repeats the experiment.

It only reads files, so it also works while the sweep runs or after it has crashed, and says what is missing. Writes
EXPERIMENT/report/index.html, which saves any of its figures as PNG."""

EXAMPLES = """\
  python -m msk_ray.report demo                            # runs/demo/report/index.html
  python -m msk_ray.report ant_ablate --baseline matched   # compare with this variant
  python -m msk_ray.report ant_lr ant_horizon --out both   # side by side
  python -m msk_ray.report demo --best never               # numbers and curves only: seconds, no simulation"""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.report", DESCRIPTION, EXAMPLES)
    p.add_argument("experiments", nargs="+", metavar="EXPERIMENT", help="names in the storage folder, or folders")
    p.add_argument(
        "--baseline",
        metavar="TEXT",
        help="compare with the variant whose name contains this (default: `baseline`, or the first variant)",
    )
    p.add_argument(
        "--best",
        choices=("auto", "always", "never"),
        default="auto",
        help="whether to evaluate the best policy and draw its film strip; auto: only if no trial is running",
    )
    p.add_argument(
        "--out", type=Path, metavar="DIR", help="folder to write to (default: report/ in the first experiment)"
    )
    p.add_argument("--device", help="cpu or cuda:N, to run the best policy (default: the first GPU, or the CPU)")
    p.add_argument("--storage", **STORAGE)
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    experiments = [find_experiment(name, args.storage) for name in args.experiments]
    if len({experiment.path for experiment in experiments}) < len(experiments):
        raise ConfigError("the same experiment twice: name each one once")
    for experiment in experiments:
        check_folder(experiment)
    folder = (args.out or experiments[0].path / "report").resolve()
    now = time.time()
    whole = [read_experiment(experiment, now) for experiment in experiments]
    readings = [part for reading in whole for part in reading.parts()]
    make_folder(folder)
    places = places_of(readings)
    prefixes = [f"{number}_" if len(readings) > 1 else "" for number in range(1, len(readings) + 1)]
    sections = [
        make_section(reading, folder, prefix, args.baseline, places)
        for reading, prefix in zip(readings, prefixes, strict=True)
    ]
    together = compare(readings, places) if len(readings) > 1 else None
    bests = [
        _best(reading, folder, prefix, args.best, args.device)
        for reading, prefix in zip(readings, prefixes, strict=True)
    ]
    sections = [replace(section, best=best) for section, best in zip(sections, bests, strict=True)]
    write_text(folder / PAGE, render_page(sections, together, now, command_of(experiments, args.storage)))
    for reading in whole:
        for warning in reading.warnings:
            print(printable(f"{reading.name}: {warning}"))
    print(printable(f"report       {folder / PAGE}"))
    return 0


def _best(reading: Reading, folder: Path, prefix: str, mode: str, device: str | None) -> Best | None:
    trial = reading.best
    if trial is None:
        return None
    make = mode == "always" or (mode == "auto" and reading.condition is not Condition.RUNNING)
    return look_at_best(trial, folder, prefix, make, device)


if __name__ == "__main__":
    sys.exit(run(main))
