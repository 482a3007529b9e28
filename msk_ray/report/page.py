"""The page: one self-contained HTML file."""

import base64
import os
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from urllib.parse import quote

import orjson
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from msk_ray import __version__
from msk_ray.cli import typed_command
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.records import TrialRecord
from msk_ray.progress import format_duration
from msk_ray.report.best import Best, strip_bytes
from msk_ray.report.charts import Picture, format_steps
from msk_ray.report.curves import gradient_health, learning_curves, stopping_map
from msk_ray.report.effect_charts import parallel_coordinates, parameter_effects
from msk_ray.report.effects import ranked_effects
from msk_ray.report.reading import Condition, Reading
from msk_ray.report.tables import (
    VariantRow,
    baseline_of,
    by_variant_and_environment,
    compare_variants,
    failures,
    outcome_counts,
    outcome_figures,
)
from msk_ray.text import printable

PAGE = "index.html"
FILES = ("config.yaml", "metrics.jsonl", "output.log", "error.txt", "eval.json", "checkpoints/best.pt")
"""Files of a trial that the page links to."""
_WORDS = {
    Condition.RUNNING: "Trials are still running: this is the state at the time above.",
    Condition.INTERRUPTED: "It has not ended, but no trial has written anything for some time: it was stopped or has "
    "crashed. The command under Repeat it, with --resume, continues it.",
    Condition.WAITING: "No trial has started yet.",
    Condition.EMPTY: "It has no trials: it was interrupted before its first file was complete, or has not started.",
    Condition.FINISHED: "",
}


@dataclass(frozen=True)
class Section:
    """One experiment of the page."""

    reading: Reading
    slug: str
    baseline: str | None
    best: Best | None
    pictures: dict[str, Picture]
    folder: Path
    """Folder of the page; links are relative to it."""
    places: Mapping[Path, int]
    """Trials' positions in the page's list."""

    def ordered(self) -> list[TrialRecord]:
        """Trials, the best score first."""
        return sorted(self.reading.trials, key=lambda t: (t.score is None, -(t.score or 0.0), t.trial.index))

    def files(self, trial: TrialRecord) -> list[tuple[str, str]]:
        """(name, link) of a trial's existing files."""
        return [(Path(name).stem, self.link(trial.folder / name)) for name in FILES if (trial.folder / name).is_file()]

    def devices(self) -> dict[str, int]:
        """Kinds of devices, and how many trials ran on each."""
        counts: dict[str, int] = {}
        for trial in self.reading.trials:
            if name := trial.device.name:
                counts[name] = counts.get(name, 0) + 1
        return counts

    def link(self, path: Path) -> str:
        return quote(Path(os.path.relpath(path, self.folder)).as_posix())

    def command(self) -> str:
        """The command that ran the experiment, as a user would type it."""
        argv = self.reading.environment.get("command")
        if not isinstance(argv, list) or not argv:
            return ""
        return typed_command([str(word) for word in argv])


def places_of(readings: Sequence[Reading]) -> dict[Path, int]:
    """Positions of all trials, by their folders, in the page's list of trials."""
    return {trial.folder: place for place, trial in enumerate(t for reading in readings for t in reading.trials)}


def make_section(
    reading: Reading, folder: Path, prefix: str, baseline: str | None, places: Mapping[Path, int]
) -> Section:
    """Make an experiment's figures.

    Args:
        folder: of the page; links are relative to it.
        prefix: of the figures' names.
        baseline: the variant that others are compared with; None: see `baseline_of`.
        places: trials' positions in the page's list.

    Raises:
        ConfigError: there is no variant with the requested name.
    """
    chosen = baseline_of(reading, baseline)
    ranked = ranked_effects(reading, places)
    several = len(reading.algorithms) > 1
    times = learning_curves(reading.variants, chosen, f"{prefix}times", places, over="seconds") if several else None
    made = {
        "curves": learning_curves(reading.variants, chosen, f"{prefix}curves", places),
        # Algorithms take different times for an env step.
        "times": times,
        "effects": parameter_effects(ranked, f"{prefix}effects"),
        "parallel": parallel_coordinates(reading, ranked, f"{prefix}parallel", places),
        "stops": stopping_map(reading, f"{prefix}stops", places),
        "health": gradient_health(reading, f"{prefix}health", places),
    }
    pictures = {key: picture for key, picture in made.items() if picture is not None}
    slug = "".join(c if c.isalnum() else "-" for c in reading.name)
    return Section(reading, slug, chosen, None, pictures, folder, places)


def compare(readings: Sequence[Reading], places: Mapping[Path, int]) -> Picture | None:
    """Learning curves of several experiments together; None if none was evaluated, or scores cannot be compared."""
    if _several_environments(readings):
        return None
    groups = {
        f"{reading.name}: {variant}": trials for reading in readings for variant, trials in reading.variants.items()
    }
    return learning_curves(groups, None, "together", places)


def command_of(experiments: Sequence[Experiment], storage: Path) -> str:
    """The command that writes the page of these experiments."""
    if all(experiment.path.parent == storage.resolve() for experiment in experiments):
        words = [*(experiment.name for experiment in experiments), "--storage", str(storage)]
    else:
        words = [str(experiment.path) for experiment in experiments]
    return shlex.join(["python", "-m", "msk_ray.report", *words])


def _openers(sections: Sequence[Section]) -> dict[str, Section]:
    """Slug of each section → the first section of the same experiment, which shows what all its sections share."""
    first: dict[Path, Section] = {}
    return {s.slug: first.setdefault(s.reading.experiment.path, s) for s in sections}


def _matrix(sections: Sequence[Section]) -> dict[str, list[VariantRow | None]]:
    """Scores by variant and environment, if the page shows one experiment in several environments."""
    parts = [section.reading for section in sections if section.reading.part]
    one = len({section.reading.experiment.path for section in sections}) == 1
    return by_variant_and_environment(parts) if one else {}


def _leaders(matrix: Mapping[str, Sequence[VariantRow | None]]) -> list[str]:
    """The variant with the highest mean score in each environment; empty if none has a score."""
    columns = zip(*matrix.values(), strict=True)
    scored = [[(row.mean, row.variant) for row in rows if row is not None and row.mean is not None] for rows in columns]
    return [max(column)[1] if column else "" for column in scored]


def _several_environments(readings: Sequence[Reading]) -> bool:
    return len({name for reading in readings for name in reading.environments}) > 1


@dataclass(frozen=True)
class Live:
    """What a page of the dashboard has in addition to one in a file."""

    refresh: float
    """Seconds between checks for changes."""
    version: str
    """Version of the content; the page fetches itself again when it changes."""
    may_write: bool
    """Whether notes can be written."""
    films: Mapping[str, tuple[str, str]]
    """Slug of a section → link to its film, empty if there is none, and what it shows or why there is none."""
    plots: str
    """Link to Optuna's plots; empty if there is nothing to plot."""


def render_page(
    sections: Sequence[Section], together: Picture | None, now: float, command: str, live: Live | None = None
) -> str:
    """The page as HTML.

    Args:
        together: the figure of all sections.
        now: seconds since the epoch.
        command: what wrote it.
        live: given by the dashboard, which serves styles and scripts as separate files.
    """
    pictures = [picture for section in sections for picture in section.pictures.values()]
    if together is not None:
        pictures.append(together)
    trials = [
        [section.reading.name, t.trial.id, printable(t.trial.variant), t.trial.seed, t.outcome, t.score]
        for section in sections
        for t in section.reading.trials
    ]
    matrix = _matrix(sections)
    data = {"trials": trials, "charts": {picture.name: picture.chart for picture in pictures}}
    page = (
        _templates()
        .get_template("report.html.j2")
        .render(
            sections=sections,
            together=together,
            openers=_openers(sections),
            experiments=list(dict.fromkeys(section.reading.experiment.name for section in sections)),
            matrix=matrix,
            leaders=_leaders(matrix),
            comparable=not _several_environments([section.reading for section in sections]),
            written=time.strftime("%Y-%m-%d %H:%M:%S %Z", time.localtime(now)),
            command=command,
            version=__version__,
            strip_uri=lambda path: _uri(strip_bytes(path)),
            live=live,
            # In a script element, "</script" would end it and "<!--" would change its meaning.
            data=Markup(orjson.dumps(data).decode().replace("<", "\\u003c")),
        )
    )
    # The recorded command may hold paths that are not UTF-8: their bytes are shown escaped.
    return page.encode("utf-8", "backslashreplace").decode()


@cache
def _templates() -> Environment:
    environment = Environment(
        loader=PackageLoader("msk_ray.report", "page"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.globals.update(
        condition_words=_WORDS,
        failures=failures,
        outcome_counts=outcome_counts,
        outcome_figures=outcome_figures,
        compare_variants=compare_variants,
    )
    environment.filters.update(
        number=_number, signed=_signed, percent=_percent, duration=format_duration, steps=format_steps
    )
    return environment


def _uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.5g}".replace("-", "\N{MINUS SIGN}")


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.4g}".replace("-", "\N{MINUS SIGN}")


def _percent(value: float) -> str:
    return f"{value:.1%}"
