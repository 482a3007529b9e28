"""`python -m msk_ray.status`: the progress of experiments, read from their files."""

import difflib
import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from msk_ray.cli import STORAGE, Parser, run, seconds
from msk_ray.errors import MskRayError, StorageError
from msk_ray.experiment.damage import count_damages, describe_damages
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.records import (
    ExperimentReader,
    TrialRecord,
    count_states,
    describe_bests,
    find_experiments,
    in_order,
    remaining,
)
from msk_ray.experiment.snapshot import State
from msk_ray.progress import format_duration
from msk_ray.step.garbage import without_collecting
from msk_ray.text import printable, printable_lines

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.table import Table

DESCRIPTION = """\
Show the progress of every trial of an experiment; without EXPERIMENT, list the experiments.

Only reads files, so it works while the sweep runs, after it has died, and from another machine with shared storage.

  running      has recently written files      interrupted  the sweep was stopped or has died: --resume continues it
  waiting      not started yet                 stale        silent for ten of its epochs, although the sweep runs
  otherwise its outcome, such as finished, asha, plateau, nonfinite, error"""

EXAMPLES = """\
  python -m msk_ray.status                              # the experiments in runs/
  python -m msk_ray.status ant_ablate --watch           # until all trials have ended, or Ctrl-C
  python -m msk_ray.status ant_ablate --storage /shared/runs"""

WIDE = 140
"""Terminal width from which hosts, GPU models and reasons are shown too."""
_STYLES = {State.RUNNING: "green", State.STALE: "yellow", State.INTERRUPTED: "yellow", State.WAITING: "dim"}
FIRST_EPOCH = "compiles kernels that are not in Warp's cache, records and trains its first epoch"
"""What a running trial does before its first epoch has ended."""


def parser() -> Parser:
    """The command line."""
    p = Parser("python -m msk_ray.status", DESCRIPTION, EXAMPLES)
    p.add_argument(
        "experiment", nargs="?", metavar="EXPERIMENT", help="name of an experiment in the storage folder, or its folder"
    )
    p.add_argument("--watch", action="store_true", help="refresh until all trials have ended")
    p.add_argument(
        "--interval", type=seconds, default=2.0, metavar="S", help="seconds between refreshes of --watch (default: 2)"
    )
    p.add_argument("--storage", **STORAGE)
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    if args.experiment is None:
        if args.watch:
            raise StorageError(f"--watch: which experiment? {_known(args.storage)}")
        return _list(args.storage)
    reader = ExperimentReader(Experiment(find(args.experiment, args.storage)), keep_rows=False)
    if args.watch:
        return _watch(reader, args.interval)
    # Which takes a sixth of the time for a table of thousands of trials.
    with without_collecting():
        _console().print(view(reader, _width()))
    return 0


def find(name: str, storage: Path) -> Path:
    """The folder of the experiment with this name or path.

    Raises:
        StorageError: there is no such experiment.
    """
    for path in (storage / name, Path(name)):
        if path.is_dir():
            return path.resolve()
    near = difflib.get_close_matches(name, [path.name for path in find_experiments(storage)], n=1)
    raise StorageError(
        f"no experiment {name!r} in {storage}; " + (f"did you mean {near[0]!r}?" if near else _known(storage))
    )


def view(reader: ExperimentReader, width: int, rows: int | None = None) -> "RenderableType":
    """An experiment as a table for a terminal of `width` columns, with at most `rows` trials.

    Raises:
        StorageError: the folder holds no readable experiment.
    """
    from rich.console import Group
    from rich.text import Text

    now = time.time()
    records, unreadable = reader.look(now, reader.planned())
    records = in_order(records)
    lines: list[RenderableType] = [Text(printable(headline(reader.experiment, records)))]
    if records:
        shown = records if rows is None else records[: max(1, rows)]
        lines.append(trial_table(shown, width, now))
        if len(shown) < len(records):
            lines.append(Text(f"... and {len(records) - len(shown)} more", style="dim"))
        if width < WIDE:  # wide tables have a column for this
            told = [record for record in shown if record.damages or record.errored]
            lines += [Text(printable(f"{record.trial.id}: {_what(record)}"), style="red") for record in told]
    else:
        lines.append(Text("no trial has started yet"))
    left_out = describe_damages(unreadable, reader.experiment.path)
    lines += [Text(printable(f"left out: {line}"), style="red") for line in left_out]
    damages = [damage for record in records for damage in record.damages]
    if damages:
        lines.append(Text(f"skipped: {count_damages(damages)}", style="red"))
    asked = reader.experiment.stop_file.exists() and any(r.state is not State.ENDED for r in records)
    if asked or any(record.state is State.INTERRUPTED for record in records):
        command = printable(reader.experiment.resume_command())
        lines.append(Text(f"{'stopped on request' if asked else 'interrupted'}; continue with: {command}"))
    return Group(*lines)


def headline(experiment: Experiment, records: Sequence[TrialRecord]) -> str:
    """`ant_lr · 2 running · 3 ended · best 12.3 (1a2b3c4d) · at most 2h05m left`; with several environments, the best
    of each."""
    parts = [experiment.name, *count_states(records)]
    if best := describe_bests(records, ids=True):
        parts.append(f"best {best}")
    left = remaining(records)
    if left is not None:
        parts.append(f"at most {format_duration(left)} left")
    return " · ".join(parts)


def trial_table(records: Sequence[TrialRecord], width: int, now: float) -> "Table":
    """One row per trial. Only the column of changes may wrap; a wide table also shows hosts and reasons."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    wide = width >= WIDE
    table = Table(box=box.SIMPLE_HEAD, width=width, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    table.add_column("trial", no_wrap=True)
    table.add_column("changed", ratio=3, overflow="fold", min_width=10)
    table.add_column("state", no_wrap=True)
    for heading in ("epoch", "best", "steps/s"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("GPU", no_wrap=True, max_width=None if wide else 4)
    for heading in ("left", "beat"):
        table.add_column(heading, justify="right", no_wrap=True)
    if wide:
        table.add_column("why", ratio=2, no_wrap=True, overflow="ellipsis")
    seeds = len({record.trial.seed for record in records}) > 1
    for record in records:
        style = "red" if record.failed else _STYLES.get(record.state, "")
        # As Text, because rich would read brackets and colons in a label as markup and emoji.
        table.add_row(*(Text(printable(cell)) for cell in _cells(record, wide, seeds, now)), style=style)
    return table


def _cells(record: TrialRecord, wide: bool, seeds: bool, now: float) -> list[str]:
    trial, progress, device, left = record.trial, record.progress, record.device, record.seconds_left
    # Shorten outcomes such as "stopped_asha" to "asha" for a narrow column.
    state = record.outcome if wide else record.outcome.removeprefix("stopped_")
    model = "" if device.gpu == "cpu" else device.name
    gpu = f"{device.host}:{device.gpu} {model}".strip() if wide and device.host else device.gpu
    cells = [
        trial.id,
        trial.variant + (f", seed {trial.seed}" if seeds else "") + record.attempt.suffix,
        state,
        f"{progress.epoch}/{trial.epochs}",
        "-" if progress.best is None else f"{progress.best:.4g}",
        short_number(progress.env_steps_per_s) if progress.env_steps_per_s is not None else "-",
        gpu,
        "-" if left is None else format_duration(left),
        # The clocks of machines that share a storage differ: a time in the future counts as now.
        "-" if record.beat is None else format_age(max(0.0, now - record.beat)),
    ]
    return [*cells, _what(record)] if wide else cells


def _what(record: TrialRecord) -> str:
    """Why a trial ended, what it is doing before its first epoch has ended, and what is wrong with its files."""
    starting = [FIRST_EPOCH] if record.state is State.RUNNING and record.epochs_done == 0 else []
    return "; ".join(filter(None, [*starting, record.why]))


def short_number(value: float) -> str:
    """Three digits and a unit: 950, 12.3k, 1.2M."""
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if value >= 0.9995 * size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}"


def format_age(seconds: float) -> str:
    """Like `format_duration`, but in days from two days on."""
    return f"{seconds / 86400:.0f}d" if seconds >= 2 * 86400 else format_duration(seconds)


def _watch(reader: ExperimentReader, interval: float) -> int:
    """Show the experiment until all its trials have ended, or until Ctrl-C."""
    console = _console()
    try:
        if console.is_terminal:
            _watch_terminal(reader, console, interval)
        else:
            while not _over(reader):
                console.print(view(reader, _width()))
                time.sleep(interval)
    except KeyboardInterrupt:
        pass  # the usual way to quit
    console.print(view(reader, _width()))
    return 0


def _watch_terminal(reader: ExperimentReader, console: "Console", interval: float) -> None:
    from rich.live import Live

    with Live(console=console, screen=True, auto_refresh=False) as live:
        while not _over(reader):
            # Leave room for the heading, the table's two lines and a note.
            live.update(view(reader, _width(), console.height - 6), refresh=True)
            time.sleep(interval)


def _over(reader: ExperimentReader) -> bool:
    records, _ = reader.look(time.time(), reader.planned())
    return bool(records) and all(record.state is State.ENDED for record in records)


def _list(storage: Path) -> int:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    paths = find_experiments(storage)
    if not paths:
        command = shlex.join(["python", "-m", "msk_ray.tune", "--storage", str(storage)])
        raise StorageError(f"no experiment in {storage}: start one with {command}, or give another --storage")
    table = Table(box=box.SIMPLE_HEAD, width=_width(), pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    for heading in ("experiment", "trials", "best"):
        table.add_column(heading, no_wrap=True)
    table.add_column("state", ratio=2, overflow="fold")
    table.add_column("question", ratio=3, no_wrap=True, overflow="ellipsis")
    for path in paths:
        table.add_row(*(Text(printable_lines(cell)) for cell in (printable(path.name), *_summary(Experiment(path)))))
    _console().print(table)
    return 0


def _summary(experiment: Experiment) -> tuple[str, str, str, str]:
    """An experiment's trials, best scores, states and question, printable; each environment's best on its own line."""
    try:
        reader = ExperimentReader(experiment, keep_rows=False)
        records, _ = reader.look(time.time(), reader.planned())
        question = experiment.manifest().get("question") or ""
    except MskRayError as error:
        return "-", "-", printable(str(error)), ""
    states = ", ".join(count_states(records)) or "no trial has started yet"
    bests = printable(describe_bests(records, ids=False)).replace(", ", "\n")
    return str(len(records)), bests or "-", states, printable(question)


def _known(storage: Path) -> str:
    names = [path.name for path in find_experiments(storage)]
    return f"there are {', '.join(names[-5:])}" if names else "it holds none; give another --storage"


def _width() -> int:
    # A pipe or file has no width: use one that fits most names.
    return shutil.get_terminal_size((120, 40)).columns


def _console() -> "Console":
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else _width(), highlight=False)


if __name__ == "__main__":
    sys.exit(run(main))
