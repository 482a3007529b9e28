"""Create an experiment, or open one to continue it."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from msk_ray.config import dump_yaml
from msk_ray.errors import MskRayError, StorageError
from msk_ray.experiment.damage import read_settings
from msk_ray.experiment.layout import ENVIRONMENT_FILE, SPACE_FILE
from msk_ray.experiment.manifest import Experiment, refuse_old
from msk_ray.experiment.provenance import environment
from msk_ray.experiment.trial import Trial, describe_changes
from msk_ray.files import check_writable, make_folder, write_json, write_text
from msk_ray.sweep.extend import extend_trials
from msk_ray.sweep.space import Space, read_file
from msk_ray.sweep.trials import with_recorded_ids
from msk_ray.text import printable


def create(path: Path, space: Space, trials: list[Trial], options: dict[str, Any]) -> Experiment:
    """Create the folder of a new experiment with its description.

    Raises:
        StorageError: the folder cannot be written, or already holds an experiment.
    """
    experiment = Experiment(path)
    refuse_old(path)
    make_folder(path)
    make_folder(path / "trials")
    write_space(experiment, space)
    write_json(path / ENVIRONMENT_FILE, environment())
    experiment.begin(space.name, space.file.question.strip(), trials, options)
    return experiment


def reopen(
    path: Path,
    trials: list[Trial] | None,
    extension: Mapping[str, Any] | None = None,
    own_trials: Callable[[], list[Trial]] | None = None,
) -> Experiment:
    """Open an experiment to continue it.

    Args:
        path: its folder.
        trials: the (extended) space's current trials, for comparison; None accepts those of the manifest.
        extension: what to extend: epochs, samples, seeds.
        own_trials: trials that the experiment's original command line would give now.

    Raises:
        StorageError: there is no experiment, it cannot be written, or its trials are not those of the current space.
        ConfigError: the extension would remove trials or epochs.
    """
    experiment = Experiment(path)
    if not path.is_dir():
        raise StorageError(f"no experiment at {path} to continue; leave out --resume and --extend to start one")
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
        other = "pass another --name (--extend adds samples, seeds or epochs)"
        if own_trials is not None and difference_of(recorded, with_recorded_ids(own_trials(), recorded)) is None:
            raise StorageError(
                f"--resume: this command line does not give the trials of {path}: {difference}; {other}, or continue "
                f"it as it was started: {experiment.resume_command()}"
            )
        raise StorageError(
            f"--resume: the space no longer gives the trials of {path}: {difference}; undo that in the space or its "
            f"base, or {other}"
        )
    # Even without a new extension: an earlier one may have been interrupted right after writing its manifest.
    experiment.clear_outgrown()
    experiment.stop_file.unlink(missing_ok=True)
    return experiment


def write_space(experiment: Experiment, space: Space) -> None:
    """Record the space with all scheduler settings written out, because a default that changes would move the rungs."""
    written = space.file.model_dump(mode="json", exclude_unset=True)
    written["scheduler"] = space.file.scheduler.model_dump(mode="json")
    write_text(experiment.path / SPACE_FILE, dump_yaml(written))


def check_scheduler(experiment: Experiment, space: Space) -> None:
    """Raise if the space's rule is not the one that has stopped trials so far.

    Raises:
        StorageError: the space's scheduler is not the recorded one.
    """
    try:
        path = experiment.path / SPACE_FILE
        recorded = read_file(read_settings(path), str(path), recorded=True).scheduler.model_dump()
    except MskRayError as error:
        # Only this check and the report use the record.
        text = " ".join(str(error).split())
        print(f"it is not known whether the space's scheduler is still the one that stopped trials: {printable(text)}")
        return
    now = space.file.scheduler.model_dump()
    if recorded["kind"] != now["kind"]:
        changes = [f"kind {recorded['kind']} → {now['kind']}"]  # each kind has its own settings
    else:
        changes = [f"{key} {recorded[key]} → {now[key]}" for key in now if now[key] != recorded[key]]
    if changes:
        raise StorageError(
            f"--resume: the space's scheduler is not the one of {experiment.path}: {', '.join(changes)}; undo that, or "
            "pass another --name"
        )


def difference_of(recorded: list[Trial], now: list[Trial]) -> str | None:
    """How two lists of trials differ, on one line; None if they are equal."""
    old, new = {trial.id: trial for trial in recorded}, {trial.id: trial for trial in now}
    gone = [trial for trial in recorded if trial.id not in new]
    added = [trial for trial in now if trial.id not in old]
    if not gone and not added:
        return None
    # Trials at the same position are most likely the same one before and after an edit, so describe the edit.
    for before, after in zip(gone, added, strict=False):
        if before.index == after.index:
            return f"trial {before.index} changed: {describe_changes(before.config, after.config)}"
    parts = [f"{len(gone)} gone ({_few(gone)})"] if gone else []
    parts += [f"{len(added)} new ({_few(added)})"] if added else []
    return ", ".join(parts)


def _few(trials: list[Trial]) -> str:
    shown = ", ".join(f"{trial.variant} seed {trial.seed}" for trial in trials[:2])
    return shown + (", ..." if len(trials) > 2 else "")
