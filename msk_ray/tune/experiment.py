"""An experiment's folder: what it is made of, how it is opened, and how it is read back without Ray.

runs/<experiment>/
    manifest.json     the trials: ids, changed parameters, full configs
    space.yaml        the space as it was run
    env.json          versions, devices, commit, command line
    owner.json        the driver at work, if there is one
    tune/             Ray's own state
    trials/<id>/      config.yaml, metrics.jsonl, checkpoints/, outcome.json, output.log, eval.json; halved.json and
                      abandoned/ if it was started anew with half its worlds
    summary.json, table.md, eval.json, report/
"""

import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

import msk_ray
from msk_ray.cli import typed_command
from msk_ray.config import current_values, dump_yaml, parse_recorded, read_yaml
from msk_ray.errors import MskRayError, StorageError, StorageFailure, brief
from msk_ray.experiment.damage import Damage, DamagedFile, cut, field, read_object, texts
from msk_ray.experiment.layout import ENVIRONMENT_FILE, MANIFEST_FILE, METRICS_FILE, OUTCOME_FILE, SPACE_FILE, STOP_FILE
from msk_ray.experiment.metrics import read_metrics
from msk_ray.experiment.outcomes import Outcome, read_ending
from msk_ray.experiment.versions import installed_versions
from msk_ray.files import check_writable, make_folder, write_json, write_text
from msk_ray.nvidia_smi import ask_driver
from msk_ray.text import printable
from msk_ray.tune.extension import extend_trials
from msk_ray.tune.space import Space, SpaceFile
from msk_ray.tune.trials import Trial, describe_changes, with_recorded_ids

FORMAT = 1
REMEMBERED = ("halve_worlds", "early_stopping")
"""Options that --resume goes on with unless it says otherwise."""
_PACKAGES = ("msk-ray", "torch", "warp-lang", "mujoco", "mujoco-warp", "ray", "numpy")


@dataclass(frozen=True)
class Experiment:
    """An experiment on disk."""

    path: Path
    """Absolute."""

    @property
    def name(self) -> str:
        return self.path.name

    def resume_command(self) -> str:
        """The command that goes on with it: the one it was begun with, and --resume, which remembers the last word on
        `REMEMBERED`."""
        flags = {f"--{no}{option.replace('_', '-')}" for option in REMEMBERED for no in ("", "no-")}
        argv = read_environment(self.path / ENVIRONMENT_FILE)[0].get("command")
        if not argv:
            # What was typed is lost, or was never whole; its options are in nobody else's hands.
            return "python -m msk_ray.tune --resume, with the options it was begun with"
        return typed_command([word for word in argv if word not in flags], "--resume")

    @property
    def tune(self) -> Path:
        """Folder of Ray's state."""
        return self.path / "tune"

    @property
    def stop_file(self) -> Path:
        return self.path / STOP_FILE

    def trial_folder(self, trial_id: str) -> Path:
        """Where a trial keeps everything."""
        return self.path / "trials" / trial_id

    def make_trial_folder(self, trial_id: str) -> Path:
        """Make a trial's folder, once, before it first starts.

        Raises:
            StorageFailure: the disk is full or gone, or the experiment has.
        """
        folder = self.trial_folder(trial_id)
        self.check_there()
        try:
            folder.mkdir(exist_ok=True)  # without those above it: an experiment that was moved is not begun again
        except OSError as error:
            raise StorageFailure(f"cannot write {folder}: {error.strerror or error}") from error
        return folder

    def check_there(self, trial_id: str | None = None) -> None:
        """Notice that the experiment, or a trial's folder, has gone since it was opened.

        Raises:
            StorageFailure: it has.
        """
        for path in (self.path / MANIFEST_FILE, *([] if trial_id is None else [self.trial_folder(trial_id)])):
            try:
                path.stat()
            except OSError as error:
                raise StorageFailure(f"{path} has gone: moved, removed or not mounted ({error.strerror})") from error

    def lost(self, trial_id: str | None = None) -> StorageFailure | None:
        """What `check_there` raises, if anything."""
        try:
            self.check_there(trial_id)
        except StorageFailure as failure:
            return failure
        return None

    def asked_to_stop(self) -> bool:
        """Whether trials are to save themselves and end.

        Raises:
            StorageFailure: the experiment has gone, and with it any such request.
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
            manifest = read_object(self.path / MANIFEST_FILE, _manifest)
        except DamagedFile as error:
            raise DamagedFile(error.damage, "restore it, or start again under another --name") from None
        if manifest is None:
            raise StorageError(f"{self.path} holds no experiment: {MANIFEST_FILE} is missing")
        return manifest

    def trials(self) -> list[Trial]:
        """The trials of the manifest."""
        trials = []
        for entry in self.manifest()["trials"]:
            config = parse_recorded(entry["config"], f"{self.path / MANIFEST_FILE}: trial {entry['id']}")
            changed, values = (current_values(entry[part], config.env.name) for part in ("changed", "values"))
            trials.append(Trial(entry["index"], entry["id"], changed, values, config))
        return trials

    def clear_endings(self, outcomes: Collection[Outcome]) -> None:
        """Take back the endings of trials that ended in one of these ways, so that they go on."""
        for trial in self.trials():
            folder = self.trial_folder(trial.id)
            ending = read_ending(folder)
            if ending is not None and ending.outcome in outcomes:
                (folder / OUTCOME_FILE).unlink()

    def said(self, option: str) -> bool | None:
        """What was said of one of `REMEMBERED` on a command line; None if nothing was, so that the space decides."""
        said: bool | None = (self.manifest().get("options") or {}).get(option)
        return said

    def say(self, **options: bool | None) -> None:
        """Keep what is said of such options now, for the next time; None says nothing."""
        manifest = self.manifest()
        said = {option: value for option, value in options.items() if value is not None}
        write_json(self.path / MANIFEST_FILE, manifest | {"options": (manifest.get("options") or {}) | said})

    def write_space(self, space: Space) -> None:
        """Record the space as it is run, its scheduler in full: a default may change, and the rungs with it."""
        written = space.file.model_dump(mode="json", exclude_unset=True)
        written["scheduler"] = space.file.scheduler.model_dump(mode="json")
        write_text(self.path / SPACE_FILE, dump_yaml(written))

    def check_scheduler(self, space: Space) -> None:
        """Refuse to go on by another rule than trials have been stopped by so far.

        Raises:
            StorageError: the space's scheduler is not the recorded one.
        """
        try:
            recorded = SpaceFile.model_validate(read_yaml(self.path / SPACE_FILE)).scheduler.model_dump()
        except (MskRayError, ValidationError) as error:
            # Nothing hangs on it but this check and the report.
            text = " ".join(str(error).split())
            print(
                f"whether the space's scheduler is still the one trials were stopped by is not known: {printable(text)}"
            )
            return
        now = space.file.scheduler.model_dump()
        changes = [f"{key} {recorded[key]} → {now[key]}" for key in now if now[key] != recorded[key]]
        if changes:
            raise StorageError(
                f"--resume: the space's scheduler is not the one of {self.path}: {', '.join(changes)}; undo that, or "
                "pass another --name"
            )

    def extension(self) -> dict[str, Any]:
        """How the experiment was extended since it was made: epochs, samples, seeds."""
        recorded: dict[str, Any] = self.manifest().get("extended", {})
        return recorded

    def extend(self, trials: Iterable[Trial], extension: Mapping[str, Any]) -> None:
        """Replace the manifest's list of trials by a longer one, and say in it what was asked for."""
        extended = {"extended": self.extension() | dict(extension)}
        write_json(
            self.path / MANIFEST_FILE, self.manifest() | extended | {"trials": [_entry(trial) for trial in trials]}
        )

    def clear_outgrown(self) -> None:
        """Take back the endings of trials that finished before their epochs were extended."""
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
        write_json(self.path / MANIFEST_FILE, self.manifest() | {"trials": [_entry(trial) for trial in trials]})


def has_begun(path: Path) -> bool:
    """Whether the folder holds a whole experiment, which --resume goes on with."""
    return (path / MANIFEST_FILE).is_file()


def refuse_old(path: Path) -> None:
    """Raise StorageError where there is an experiment already."""
    if has_begun(path):
        raise StorageError(f"{path} holds an experiment already: add --resume to go on with it, or pass another --name")


def create(path: Path, space: Space, trials: list[Trial], options: dict[str, Any]) -> Experiment:
    """Make a new experiment's folder and say in it what it is.

    Raises:
        StorageError: the folder cannot be written, or holds an experiment already.
    """
    experiment = Experiment(path)
    refuse_old(path)
    make_folder(path)
    make_folder(path / "trials")
    experiment.write_space(space)
    write_json(path / ENVIRONMENT_FILE, environment())
    manifest = {
        "format": FORMAT,
        "name": path.name,
        "space": space.name,
        "question": space.file.question.strip(),
        "created": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "options": options,
        "trials": [_entry(trial) for trial in trials],
    }
    # Last: a folder with a manifest is a whole experiment.
    write_json(path / MANIFEST_FILE, manifest)
    return experiment


def reopen(path: Path, trials: list[Trial] | None, extension: Mapping[str, Any] | None = None) -> Experiment:
    """Open an experiment to go on with it.

    Args:
        path: its folder.
        trials: what the space, extended, resolves to now, to be compared; None to take the manifest's word.
        extension: what to extend it by: epochs, samples, seeds.

    Raises:
        StorageError: there is none, it cannot be written, or its trials are not those of the space as it is now.
        ConfigError: the extension takes something away.
    """
    experiment = Experiment(path)
    if not path.is_dir():
        raise StorageError(f"no experiment at {path} to go on with; leave --resume and --extend out to start one")
    recorded = experiment.trials()
    check_writable(path)
    if trials is not None:
        trials = with_recorded_ids(trials, recorded)
    if extension:
        assert trials is not None
        recorded = extend_trials(recorded, trials, extension.get("epochs"))
        experiment.extend(recorded, extension)
    difference = difference_of(recorded, trials) if trials is not None else None
    if difference:
        raise StorageError(
            f"--resume: the space no longer gives the trials of {path}: {difference}; undo that, or pass another "
            f"--name (--extend adds samples, seeds or epochs). As it was begun, it goes on with: "
            f"{experiment.resume_command()}"
        )
    # Also without a new extension: an earlier one may have been interrupted right after its manifest.
    experiment.clear_outgrown()
    experiment.stop_file.unlink(missing_ok=True)
    return experiment


def difference_of(recorded: list[Trial], now: list[Trial]) -> str | None:
    """How two lists of trials differ, on one line; None if they are the same."""
    old, new = {trial.id: trial for trial in recorded}, {trial.id: trial for trial in now}
    gone = [trial for trial in recorded if trial.id not in new]
    added = [trial for trial in now if trial.id not in old]
    if not gone and not added:
        return None
    # Trials at the same place were most likely one trial before an edit; then the edit itself says the most.
    for before, after in zip(gone, added, strict=False):
        if before.index == after.index:
            return f"trial {before.index} changed: {describe_changes(before.config, after.config)}"
    parts = [f"{len(gone)} gone ({_few(gone)})"] if gone else []
    parts += [f"{len(added)} new ({_few(added)})"] if added else []
    return ", ".join(parts)


def check_name(name: str) -> str:
    """An experiment's name, which becomes a folder's.

    Raises:
        StorageError: it would not be a plain folder name.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}", name):
        raise StorageError(f"--name {brief(name)}: use at most 128 letters, digits, '.', '_' and '-'")
    return name


def _manifest(data: dict[str, Any]) -> dict[str, Any]:
    """A manifest as it is.

    Raises:
        ValueError: it is none that this version reads.
    """
    if data.get("format") != FORMAT:
        raise ValueError(f"it has format {data.get('format')!r:.40}, this version reads {FORMAT}")
    for number, entry in enumerate(field(data, "trials", list)):
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


_ENVIRONMENT = {
    "command": list,
    "python": str,
    "platform": str,
    "host": str,
    "cpus": int,
    "gpus": list,
    "driver": str,
    "packages": dict,
    "commit": str,
}


def read_environment(path: Path) -> tuple[dict[str, Any], list[Damage]]:
    """What an experiment ran with, as far as its file says, and what of it cannot be used.

    Raises:
        StorageFailure: the storage does not give it.
    """
    damages: list[Damage] = []

    def usable(data: dict[str, Any]) -> dict[str, Any]:
        found = {}
        for name in data.keys() & _ENVIRONMENT.keys():
            if data[name] is None:
                continue  # not known, which null says
            try:
                value: Any = field(data, name, _ENVIRONMENT[name])
                inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
                if not texts(inner):
                    raise ValueError(f"{name} holds something else than texts")
                found[name] = value
            except ValueError as error:
                damages.append(Damage(path, cut(error)))
        return {name: found[name] for name in _ENVIRONMENT if name in found}

    try:
        return read_object(path, usable) or {}, damages
    except DamagedFile as error:
        return {}, [error.damage]


def environment() -> dict[str, Any]:
    """What the experiment ran with: versions, command, and the machine it was started on."""
    driver = ask_driver()
    return {
        "command": sys.argv,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "host": platform.node(),
        "cpus": os.cpu_count(),
        "gpus": list(driver.gpus),
        "driver": driver.driver,
        "packages": installed_versions(_PACKAGES),
        "commit": _commit(),
    }


def _commit() -> str | None:
    """The checkout's commit, `+` for uncommitted changes; None outside a checkout."""
    root = Path(msk_ray.__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    try:
        head = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        changes = subprocess.run(
            ["git", "-C", str(root), "status", "--porcelain"], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        # git is not installed, or refuses a folder of another owner: the commit is unknown, which null says.
        return None
    return head.stdout.strip() + ("+" if changes.stdout.strip() else "")


def _entry(trial: Trial) -> dict[str, Any]:
    return {
        "index": trial.index,
        "id": trial.id,
        "changed": trial.changed,
        "values": trial.values,
        "config": trial.config.as_dict(),
    }


def _few(trials: list[Trial]) -> str:
    shown = ", ".join(f"{trial.variant} seed {trial.seed}" for trial in trials[:2])
    return shown + (", ..." if len(trials) > 2 else "")
