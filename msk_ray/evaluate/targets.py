"""What commands take as their target (a checkpoint, a trial's folder, an experiment, or a folder of policies), and the
names of physics."""

import difflib
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from msk_ray.errors import CheckpointError, StorageError
from msk_ray.experiment import layout
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.records import best_records, find_experiments, read_records
from msk_ray.shipped import POLICIES, find_shipped, shipped_folder, shipped_names

REFERENCE, OWN = "reference", "own"
"""Names that `--physics` takes besides those of the environment: the physics of scores, and the physics of the trial's
training."""


class Kind(StrEnum):
    """The kinds of targets."""

    CHECKPOINT = "checkpoint"
    TRIAL = "trial"
    EXPERIMENT = "experiment"
    ZOO = "zoo"
    """A folder of policies, each a .pt file with a .yaml beside it."""


@dataclass(frozen=True)
class Target:
    """What a user named."""

    kind: Kind
    path: Path
    """Absolute; a file for a checkpoint, else a folder."""


def find_target(text: str, storage: Path) -> Target:
    """The checkpoint, trial or experiment at a path, the experiment of that name in `storage`, the policy of that name
    in `policies/`, or all of `policies/`.

    Raises:
        StorageError: there is none.
    """
    shipped = [shipped_folder() / POLICIES] if Path(text) == Path(POLICIES) else []
    for path in (storage / text, Path(text), *shipped):
        if path.is_file():
            if path.suffix != ".pt":
                raise StorageError(f"{path} is not a checkpoint: give a .pt file, a trial's folder or an experiment")
            return Target(Kind.CHECKPOINT, path.resolve())
        if path.is_dir():
            return Target(_kind_of(path), path.resolve())
    if (policy := find_shipped(text, POLICIES, ".pt")) is not None:
        return Target(Kind.CHECKPOINT, policy)
    names = [path.name for path in find_experiments(storage)]
    near = difflib.get_close_matches(text, names, n=1)
    if near:
        hint = f"did you mean {near[0]!r}?"
    else:
        trained = ", ".join(shipped_names(POLICIES, ".pt"))
        hint = (
            f"{storage} holds {', '.join(names[-5:]) or 'no experiment'}, policies/ {trained}; give a .pt file, a "
            "trial's folder or one of these"
        )
    raise StorageError(f"no checkpoint, trial or experiment {text!r}; {hint}")


def find_experiment(text: str, storage: Path) -> Experiment:
    """The experiment of a name or at a path.

    Raises:
        StorageError: there is none, or it is something else.
    """
    target = find_target(text, storage)
    if target.kind is not Kind.EXPERIMENT:
        raise StorageError(f"{target.path} is a {target.kind}, not an experiment")
    return Experiment(target.path)


def checkpoint_of(target: Target) -> Path:
    """The checkpoint that a target stands for: the target itself, a trial's best, or the best trial's best.

    Raises:
        CheckpointError: there is none yet, or there are several, one for each environment.
    """
    if target.kind is Kind.CHECKPOINT:
        return target.path
    if target.kind is Kind.ZOO:
        names = ", ".join(sorted(path.name for path in target.path.glob("*.pt")))
        raise CheckpointError(f"{target.path} holds several policies; give one of them: {names}")
    return best_of_trial(best_trial_folder(target))


def best_trial_folder(target: Target) -> Path:
    """The folder of the trial that a target stands for.

    Raises:
        CheckpointError: no trial of the experiment has a score yet, or its trials run in several environments, whose
            scores cannot be compared.
    """
    if target.kind is Kind.CHECKPOINT:
        return trial_folder_of(target.path)
    if target.kind is Kind.TRIAL:
        return target.path
    bests = best_records(read_records(Experiment(target.path)))
    if not bests:
        raise CheckpointError(
            f"no trained policy of {target.path} has a score yet: wait for the first evaluation, or name a trial to "
            "look at its untrained policy"
        )
    if len(bests) > 1:
        choices = ", ".join(f"{best.folder} ({name})" for name, best in bests.items())
        raise CheckpointError(
            f"{target.path} has a best trial for each environment, because their scores cannot be compared; give one "
            f"of them: {choices}"
        )
    (best,) = bests.values()
    return best.folder


def best_of_trial(folder: Path) -> Path:
    """The checkpoint of a trial's best policy.

    Raises:
        CheckpointError: there is none yet.
    """
    path = layout.best_checkpoint_in(folder)
    if not path.is_file():
        raise CheckpointError(
            f"{folder} has no checkpoints/{path.name}: the trial has not been evaluated yet, or the file was lost"
        )
    return path


def trial_folder_of(checkpoint: Path) -> Path:
    """The folder of the trial that a checkpoint belongs to; the checkpoint's own folder if there is no trial."""
    return checkpoint.parent.parent if checkpoint.parent.name == "checkpoints" else checkpoint.parent


def _kind_of(path: Path) -> Kind:
    if any((path / part).exists() for part in (layout.MANIFEST_FILE, layout.SPACE_FILE, "trials")):
        return Kind.EXPERIMENT
    if any((path / part).exists() for part in ("checkpoints", "config.yaml", layout.METRICS_FILE)):
        return Kind.TRIAL
    if path.name == "checkpoints":
        raise StorageError(f"{path}: give one of its .pt files, or the trial's folder above it")
    if any(path.glob("*.pt")):
        return Kind.ZOO
    # An experiment that died before its first file is an empty folder; its reader says what is wrong with it.
    return Kind.EXPERIMENT
