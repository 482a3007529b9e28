"""The experiments of a storage folder; files are read and pages made again only after changes."""

import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO

from jinja2 import Environment, PackageLoader, StrictUndefined

from msk_ray import __version__
from msk_ray.dashboard.films import FOLDER, PREFIX, Film, Films
from msk_ray.dashboard.plots import can_plot, figures
from msk_ray.errors import ConfigError, MskRayError, StorageError
from msk_ray.experiment.layout import EVAL_FILE
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.records import ExperimentReader, count_states, describe_bests, find_experiments
from msk_ray.experiment.snapshot import file_stamp
from msk_ray.experiment.trainings import TrainingReader
from msk_ray.files import UnusableFile, open_file
from msk_ray.report.best import STRIP, stored_best
from msk_ray.report.page import Live, Section, command_of, compare, make_section, places_of, render_page
from msk_ray.report.reading import Reading, explain, read_again

_READERS, _PAGES = 8, 16
"""How many experiments and pages are kept in memory."""
_REST = 3.0
"""A page that took t seconds to make is made again after this many times t at the earliest."""


class Unknown(Exception):
    """There is nothing of this name."""


@dataclass(frozen=True)
class Page:
    """A page as it was last made."""

    version: str
    html: str


@dataclass
class _CachedPage:
    page: Page
    seen: tuple[Any, ...]
    """What it was made from. A reader returns the same object for a trial that has not changed."""
    due: float
    """When it is checked again, as monotonic time [s]."""


class Library:
    """Makes the pages. Its methods may be called from several threads."""

    def __init__(self, storage: Path, refresh: float, may_write: bool, films: Films | None) -> None:
        """
        Args:
            storage: folder of experiments.
            refresh: seconds between looks at the files.
            may_write: whether pages have fields for notes.
            films: makes the films; None: no films.
        """
        self.storage = storage
        self._root = storage.resolve()
        self._trainings = TrainingReader(self._root)
        self._refresh = refresh
        self._may_write = may_write
        self._films = films
        self._lock = threading.Lock()
        self._readers: OrderedDict[str, ExperimentReader] = OrderedDict()
        self._rowless: dict[str, ExperimentReader] = {}
        """For the list of experiments, which needs no curves."""
        self._pages: OrderedDict[tuple[str, ...], _CachedPage] = OrderedDict()

    def index(self) -> Page:
        """The list of experiments."""
        with self._lock:
            return self._cached((), lambda: (self._rows(), self._training_rows()), self._render_index)

    def page(self, names: Sequence[str]) -> Page:
        """The page of one experiment, or of several side by side.

        Raises:
            Unknown: there is no experiment of one of the names.
        """
        with self._lock:
            experiments = [self._find(name) for name in names]
            return self._cached(
                tuple(names),
                lambda: self._look(experiments),
                lambda seen, version: self._render(experiments, version),
            )

    def plots(self, name: str) -> str:
        """Optuna's plots of an experiment, as a page.

        Raises:
            Unknown: there is no such experiment.
        """
        with self._lock:
            reading = self._read(self._find(name))
        made, missing = [], ""
        try:
            if not can_plot(reading):
                raise ConfigError("Optuna's plots need an experiment of one environment that varies parameters")
            made = figures(reading)
        except MskRayError as error:
            missing = explain(error)
        return _templates().get_template("plots.html.j2").render(name=name, figures=made, missing=missing)

    def report_file(self, name: str, file: str) -> Path:
        """A film or a film strip.

        Raises:
            Unknown: the experiment has no such file.
        """
        with self._lock:
            folder = self._find(name).path / FOLDER
        # Chosen among existing files: a name from a request never becomes a path.
        files = {path.name: path for pattern in (f"{PREFIX}*.mp4", f"*{STRIP}*.png") for path in folder.glob(pattern)}
        if file not in files:
            raise Unknown(f"{name} has no {file}")
        return files[file]

    def trial_folder(self, name: str, trial: str) -> Path:
        """The folder of a trial.

        Raises:
            Unknown: there is no such trial.
        """
        with self._lock:
            return self._trial_folder(name, trial)

    def write(self, write_note: Callable[[Path, str, str], None], name: str, trial: str, text: str) -> None:
        """Write a note on a trial.

        Raises:
            Unknown: there is no such trial.
            MskRayError: as for `write_note`.
        """
        with self._lock:
            self._trial_folder(name, trial)
            write_note(self._find(name).path, trial, text)
            for kept in self._pages.values():
                kept.due = 0.0

    def open(self, path: Path) -> BinaryIO:
        """A file of the storage, opened.

        Raises:
            Unknown: there is no such file, or it is not in the storage.
        """
        try:
            file = open_file(path)
        except (OSError, UnusableFile) as error:
            raise Unknown(
                f"no file {path.name} here: {error if isinstance(error, UnusableFile) else error.strerror}"
            ) from None
        # Checked on the open file, because a folder above it may be a link.
        if not Path(f"/proc/self/fd/{file.fileno()}").readlink().is_relative_to(self._root):
            file.close()
            raise Unknown(f"no file {path.name} here: a link leads out of the storage")
        return file

    def _find(self, name: str) -> Experiment:
        paths = {path.name: path for path in find_experiments(self._root)}
        if name not in paths:
            raise Unknown(f"no experiment {name!r} here")
        self._check_inside(paths[name])
        return Experiment(paths[name])

    def _check_inside(self, path: Path) -> None:
        """Refuse an experiment with a folder outside the storage: a link must not make other files readable.

        Raises:
            StorageError: a link leads out of the storage.
        """
        trials = path / "trials"
        inner = [Path(entry) for entry in os.scandir(trials) if entry.is_symlink()] if trials.is_dir() else []
        for folder in (path, trials, path / FOLDER, *inner):
            if not folder.resolve().is_relative_to(self._root):
                relative = folder.relative_to(self._root)
                raise StorageError(f"{relative} is a link out of the storage: put the folder itself there")

    def _trial_folder(self, name: str, trial: str) -> Path:
        folders = {t.trial.id: t.folder for t in self._read(self._find(name)).trials}
        if trial not in folders:
            raise Unknown(f"{name} has no trial {trial!r}")
        return folders[trial]

    def _cached(
        self,
        key: tuple[str, ...],
        look: Callable[[], tuple[Any, ...]],
        render: Callable[[tuple[Any, ...], str], str],
    ) -> Page:
        """The page cached under `key`, made again if `look` sees a change."""
        kept = self._pages.get(key)
        if kept is not None and time.monotonic() < kept.due:
            return kept.page
        started = time.monotonic()
        seen = look()
        if kept is None or kept.seen != seen:
            version = sha256(f"{key}{time.time_ns()}".encode()).hexdigest()[:16]
            kept = _CachedPage(Page(version, render(seen, version)), seen, 0.0)
            self._pages[key] = kept
            while len(self._pages) > _PAGES:
                self._pages.popitem(last=False)
        self._pages.move_to_end(key)
        took = time.monotonic() - started
        kept.due = time.monotonic() + max(0.5 * self._refresh, _REST * took)
        return kept.page

    def _read(self, experiment: Experiment) -> Reading:
        reader = self._readers.setdefault(experiment.name, ExperimentReader(experiment))
        self._readers.move_to_end(experiment.name)
        while len(self._readers) > _READERS:
            self._readers.popitem(last=False)
        return read_again(reader, time.time())

    def _look(self, experiments: Sequence[Experiment]) -> tuple[Any, ...]:
        readings = [self._read(experiment) for experiment in experiments]
        parts = [part for reading in readings for part in reading.parts()]
        evaluated = [file_stamp(part.best.folder / EVAL_FILE) for part in parts if part.best is not None]
        drawn = [(path, file_stamp(path)) for experiment in experiments for path in _strips(experiment)]
        return readings, evaluated, drawn, [self._film(part) for part in parts]

    def _film(self, part: Reading) -> Film | None:
        best = part.best
        if self._films is None or best is None or best.best_checkpoint is None:
            return None
        return self._films.of(part.experiment, part.part, best.best_checkpoint)

    def _render(self, experiments: Sequence[Experiment], version: str) -> str:
        whole = [self._read(experiment) for experiment in experiments]
        readings = [part for reading in whole for part in reading.parts()]
        places = places_of(readings)
        folder = experiments[0].path
        sections: list[Section] = []
        films: dict[str, tuple[str, str]] = {}
        for number, reading in enumerate(readings, start=1):
            prefix = f"{number}_" if len(readings) > 1 else ""
            section = make_section(reading, folder, prefix, None, places)
            best = reading.best
            if best is not None:
                section = replace(section, best=stored_best(best, _strips(reading.experiment)))
            sections.append(section)
            film = self._film(reading)
            if film is not None:
                link = section.link(reading.experiment.path / film.link) if film.link else ""
                films[section.slug] = link, film.words
        plots = "plots" if len(whole) == 1 and can_plot(whole[0]) else ""
        live = Live(self._refresh, version, self._may_write, films, plots)
        together = compare(readings, places) if len(readings) > 1 else None
        return render_page(sections, together, time.time(), command_of(experiments, self.storage), live)

    def _rows(self) -> list[tuple[str, ...]]:
        rows: list[tuple[str, ...]] = []
        for path in reversed(find_experiments(self._root)):
            reader = self._rowless.setdefault(path.name, ExperimentReader(Experiment(path), keep_rows=False))
            try:
                self._check_inside(path)
                records, _ = reader.look(time.time(), reader.planned())
                question = str(Experiment(path).manifest().get("question") or "")
            except MskRayError as error:
                rows.append((path.name, "", "", explain(error), ""))
                continue
            score = describe_bests(records, ids=False)
            state = ", ".join(count_states(records)) or "no trial has started yet"
            rows.append((path.name, str(len(records)), score, state, question))
        return rows

    def _training_rows(self) -> tuple[tuple[str, ...], ...]:
        """Folder, environment, epochs, best score and state of each run of `train`."""
        return tuple(
            (
                training.name,
                training.environment,
                f"{training.progress.epoch}/{training.epochs or '?'}",
                "" if training.progress.best is None else f"{training.progress.best:.5g}",
                "; ".join(filter(None, (str(training.state), training.note))),
            )
            for training in self._trainings.look(time.time())
        )

    def _render_index(self, seen: tuple[Any, ...], version: str) -> str:
        return (
            _templates()
            .get_template("index.html.j2")
            .render(
                rows=seen[0],
                trainings=seen[1],
                storage=str(self.storage),
                version=version,
                refresh=self._refresh,
                written=__version__,
            )
        )


def _strips(experiment: Experiment) -> list[Path]:
    """Film strips that reports have drawn."""
    return sorted((experiment.path / FOLDER).glob(f"*{STRIP}.png"))


@cache
def _templates() -> Environment:
    return Environment(
        loader=PackageLoader("msk_ray.dashboard", "page"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
