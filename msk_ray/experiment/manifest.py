"""An experiment's folder: its files, its owner, and its manifest.

runs/<experiment>/
    manifest.json     the trials: ids, changed parameters, full configs
    space.yaml        the space as it was run
    env.json          versions, devices, commit, command line
    owner.json        the driver at work, if there is one
    tune/             Ray's own state
    trials/<id>/      config.yaml, metrics.jsonl, checkpoints/, outcome.json, output.log, eval.json; halved.json and
                      abandoned/ if it was restarted with half its worlds
    summary.json, table.md, eval.json, report/
    notes.json        what people have written about trials in the dashboard
"""

import contextlib
import os
import re
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msk_ray.cli import option_value, typed_command, with_option
from msk_ray.config import current_values, parse_recorded
from msk_ray.errors import ConfigError, StorageError, StorageFailure, brief
from msk_ray.experiment.damage import CATALOGUE, DamagedFile, field, read_object, texts
from msk_ray.experiment.layout import ENVIRONMENT_FILE, MANIFEST_FILE, METRICS_FILE, OUTCOME_FILE, STOP_FILE
from msk_ray.experiment.metrics import read_metrics
from msk_ray.experiment.outcomes import Outcome, read_ending
from msk_ray.experiment.ownership import Ownership, owned
from msk_ray.experiment.provenance import read_environment
from msk_ray.experiment.trial import Trial
from msk_ray.files import check_writable, make_folder, write_json

FORMAT = 1
MAX_TRIALS = 100_000
"""Trials of an experiment."""
STORAGE = "runs"
"""Folder of experiments unless another is given."""
REMEMBERED = ("halve_worlds", "early_stopping")
"""Options that --resume keeps unless they are given again."""


@dataclass(frozen=True)
class Experiment:
    """An experiment on disk."""

    path: Path
    """Absolute."""

    @property
    def name(self) -> str:
        return self.path.name

    def resume_command(self) -> str:
        """The command that continues the experiment: the original one with --resume and the experiment's current name
        and storage folder. --resume keeps the latest values of `REMEMBERED`."""
        flags = {f"--{no}{option.replace('_', '-')}" for option in REMEMBERED for no in ("", "no-")}
        argv = read_environment(self.path / ENVIRONMENT_FILE)[0].get("command")
        if not argv:
            # The command is lost or incomplete; its options are not recorded anywhere else.
            return "python -m msk_ray.tune --resume, with the options it was started with"
        words = [word for word in argv if word not in flags]
        if Path(option_value(words, "--storage") or STORAGE).resolve() != self.path.parent.resolve():
            words = with_option(words, "--storage", str(self.path.parent))
        space = option_value(words, "--space")
        named = option_value(words, "--name") or (space and default_name(space, "--smoke" in words))
        if named is not None and named != self.name:
            words = with_option(words, "--name", self.name)
        return typed_command(words, "--resume")

    @property
    def tune(self) -> Path:
        """Folder of Ray's own files."""
        return self.path / "tune"

    @property
    def stop_file(self) -> Path:
        return self.path / STOP_FILE

    def trial_folder(self, trial_id: str) -> Path:
        """The folder of a trial."""
        return self.path / "trials" / trial_id

    def make_trial_folder(self, trial_id: str) -> Path:
        """Create a trial's folder, once, before it first starts.

        Raises:
            StorageFailure: the disk is full or gone, or the experiment has disappeared.
        """
        folder = self.trial_folder(trial_id)
        self.check_there()
        try:
            folder.mkdir(exist_ok=True)  # without parents, so that an experiment that was moved is not started again
        except OSError as error:
            raise StorageFailure(f"cannot write {folder}: {error.strerror or error}") from error
        return folder

    def check_there(self, trial_id: str | None = None) -> None:
        """Check that the experiment, and a trial's folder, still exist.

        Raises:
            StorageFailure: they do not.
        """
        for path in (self.path / MANIFEST_FILE, *([] if trial_id is None else [self.trial_folder(trial_id)])):
            try:
                path.stat()
            except OSError as error:
                raise StorageFailure(
                    f"{path} does not exist: moved, removed or not mounted ({error.strerror})"
                ) from error

    def lost(self, trial_id: str | None = None) -> StorageFailure | None:
        """The error that `check_there` would raise; None if it would not."""
        try:
            self.check_there(trial_id)
        except StorageFailure as failure:
            return failure
        return None

    def asked_to_stop(self) -> bool:
        """Whether trials should save themselves and end.

        Raises:
            StorageFailure: the experiment has disappeared.
        """
        if self.stop_file.exists():
            return True
        self.check_there()
        return False

    def manifest(self) -> dict[str, Any]:
        """The manifest as plain data.

        Raises:
            StorageError: missing, unreadable, or of another format.
        """
        try:
            manifest = read_object(self.path / MANIFEST_FILE, _manifest, CATALOGUE)
        except DamagedFile as error:
            raise DamagedFile(error.damage, "restore it, or start again under another --name") from None
        if manifest is None:
            raise StorageError(f"{self.path} holds no experiment: {MANIFEST_FILE} is missing")
        return manifest

    def begin(self, space: str, question: str, trials: Sequence[Trial], options: Mapping[str, Any]) -> None:
        """Write the manifest of a new experiment, as the last of its files: a folder with a manifest is complete.

        Args:
            space: name of its space.
            question: the question that it answers.
            trials: all trials known so far.
            options: command-line options.
        """
        manifest = {
            "format": FORMAT,
            "name": self.name,
            "space": space,
            "question": question,
            "created": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "options": dict(options),
            "trials": _entries(trials),
        }
        write_json(self.path / MANIFEST_FILE, manifest)

    def trials(self, *, shown: bool = False) -> list[Trial]:
        """The trials of the manifest.

        Args:
            shown: for display only; see `parse_recorded`.
        """
        trials = []
        for entry in self.manifest()["trials"]:
            config = parse_recorded(entry["config"], f"{self.path / MANIFEST_FILE}: trial {entry['id']}", shown=shown)
            changed, values = (current_values(entry[part]) for part in ("changed", "values"))
            trials.append(Trial(entry["index"], entry["id"], changed, values, config))
        return trials

    def clear_endings(self, outcomes: Collection[Outcome]) -> None:
        """Remove the endings of trials with one of these outcomes, so that they continue."""
        for trial in self.trials():
            folder = self.trial_folder(trial.id)
            ending = read_ending(folder)
            if ending is not None and ending.outcome in outcomes:
                (folder / OUTCOME_FILE).unlink()

    def remembered(self, option: str) -> bool | None:
        """The value that a command line gave for one of `REMEMBERED`; None if none did, and the space decides."""
        value: bool | None = (self.manifest().get("options") or {}).get(option)
        return value

    def remember(self, **options: bool | None) -> None:
        """Record the values that this command line gives for `REMEMBERED`; None changes nothing."""
        given = {option: value for option, value in options.items() if value is not None}
        self._change(options=(self.manifest().get("options") or {}) | given)

    def extension(self) -> dict[str, Any]:
        """How the experiment has been extended since it was created: epochs, samples, seeds."""
        recorded: dict[str, Any] = self.manifest().get("extended", {})
        return recorded

    def extend(self, trials: Iterable[Trial], extension: Mapping[str, Any]) -> None:
        """Replace the manifest's list of trials by a longer one, and record the extension."""
        self._change(extended=self.extension() | dict(extension), trials=_entries(trials))

    def clear_outgrown(self) -> None:
        """Remove the endings of trials that finished before their epochs were extended."""
        for trial in self.trials():
            folder = self.trial_folder(trial.id)
            ending = read_ending(folder)
            if ending is None or ending.outcome is not Outcome.FINISHED:
                continue
            rows = read_metrics(folder / METRICS_FILE)
            if rows and rows[-1]["epoch"] < trial.epochs:
                (folder / OUTCOME_FILE).unlink()

    def set_trials(self, trials: Iterable[Trial]) -> None:
        """Replace the manifest's list of trials."""
        self._change(trials=_entries(trials))

    def _change(self, **parts: Any) -> None:
        write_json(self.path / MANIFEST_FILE, self.manifest() | parts)


def has_begun(path: Path) -> bool:
    """Whether the folder holds an experiment with a manifest, readable or not."""
    return os.path.lexists(path / MANIFEST_FILE)


def refuse_old(path: Path) -> None:
    """Raise StorageError if there already is an experiment."""
    if has_begun(path):
        raise StorageError(f"{path} already holds an experiment: add --resume to continue it, or pass another --name")


def default_name(space: str, smoke: bool) -> str:
    """A default name for an experiment.

    Args:
        space: name or file of its space, as given.
        smoke: whether it is a smoke run.
    """
    return Path(space).stem + ("-smoke" if smoke else "")


def check_name(name: str) -> str:
    """Check an experiment's name, which becomes a folder name.

    Raises:
        StorageError: it is not a plain folder name.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}", name):
        raise StorageError(f"--name {brief(name)}: use at most 128 letters, digits, '.', '_' and '-'")
    return name


def _manifest(data: dict[str, Any]) -> dict[str, Any]:
    """Check the content of a manifest.

    Raises:
        ValueError: this version cannot read it.
    """
    if data.get("format") != FORMAT:
        raise ValueError(f"it has format {data.get('format')!r:.40}, this version reads {FORMAT}")
    entries = field(data, "trials", list)
    if len(entries) > MAX_TRIALS:
        raise ValueError(f"{len(entries)} trials, more than {MAX_TRIALS}")
    for number, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise ValueError(f"trial {number} is no object")
        try:
            field(entry, "index", int)
            if not re.fullmatch(r"[A-Za-z0-9_-]+", field(entry, "id", str)):
                raise ValueError("id is no trial's")
            if not texts(field(entry, "changed", dict).values()):
                raise ValueError("changed holds something else than texts")
            field(entry, "values", dict)
            field(entry, "config", dict)
        except ValueError as error:
            raise ValueError(f"trial {number}: {error}") from None
    for name, kind in (("question", str), ("options", dict), ("extended", dict)):
        if data.get(name) is not None:
            field(data, name, kind)
    return data


def _entries(trials: Iterable[Trial]) -> list[dict[str, Any]]:
    entries = [_entry(trial) for trial in trials]
    if len(entries) > MAX_TRIALS:
        raise ConfigError(f"{len(entries)} trials, more than an experiment's {MAX_TRIALS}: make several of them")
    return entries


def _entry(trial: Trial) -> dict[str, Any]:
    return {
        "index": trial.index,
        "id": trial.id,
        "changed": trial.changed,
        "values": trial.values,
        "config": trial.config.as_dict(),
    }


@contextlib.contextmanager
def own(path: Path, *, new: bool, force: bool = False) -> Iterator[Ownership]:
    """Own an experiment's folder during a block, before anything in it is written.

    Args:
        path: its folder; created for a new experiment.
        new: whether to start the experiment rather than continue it.
        force: take it over even if its driver seems to be running.

    Raises:
        StorageError: the experiment already exists, or does not; another driver is running; the folder cannot be
            written.
    """
    if new:
        refuse_old(path)
        make_folder(path)
    elif not path.is_dir():
        raise StorageError(f"no experiment at {path} to continue; leave out --resume and --extend to start one")
    else:
        check_writable(path)
    with owned(path, force) as ownership:
        yield ownership
