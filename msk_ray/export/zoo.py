"""Add a trained policy to a zoo (`evaluate.zoo`)."""

import io
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from msk_ray.algorithms import algorithm_class
from msk_ray.cli import typed_command
from msk_ray.config import Config, dump_yaml, flattened, overlay, parse_recorded
from msk_ray.errors import ConfigError, StorageError
from msk_ray.evaluate.measure import Bench, Request
from msk_ray.evaluate.targets import REFERENCE, trial_folder_of
from msk_ray.evaluate.zoo import BEGIN, BEST_EVALUATION, END, MAX_BYTES, Entry, Training, read_zoo, score_of, zoo_text
from msk_ray.experiment.checkpoint_format import write_checkpoint_file
from msk_ray.experiment.layout import ENVIRONMENT_FILE, best_checkpoint_in
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.provenance import read_environment
from msk_ray.experiment.snapshot import read_trial
from msk_ray.export.compare import CHECKED, compare_with_checkpoint, observations
from msk_ray.export.network import to_torchscript
from msk_ray.export.write import policy_to_control
from msk_ray.files import make_folder, write_bytes, write_text
from msk_ray.training import SavedPolicy, load_policy
from msk_ray.training.checkpoint import load_checkpoint

README = "README.md"


@dataclass(frozen=True)
class Origin:
    """How a policy was trained; None: as its trial records."""

    command: str | None = None
    commit: str | None = None
    machine: str | None = None
    chosen: str | None = None
    """How the checkpoint was chosen; None: it is the trial's best.pt."""


def add_to_zoo(checkpoint: Path, target: Path, given: Origin, seeds: Sequence[int], device: str) -> Iterator[str]:
    """Write the policy of a checkpoint to `target`.pt and its record to `target`.yaml, and update the table in the
    folder's README.md, if there is one. Yields a line about each step.

    Before anything is written, the policy as it will be stored is exported, compared with that export, and evaluated
    from the initial states of `seeds`.

    Args:
        checkpoint: of a finished or running trial.
        target: path of the entry without a suffix.
        given: replaces what the trial records of its origin.
        seeds: of the initial states.
        device: for the evaluation.

    Raises:
        ConfigError: it is not recorded how the policy was trained or how its checkpoint was chosen; the policy is
            untrained or too large; or the settings name files of this machine.
        ExportError: the exported policy differs from the stored one.
        CheckpointError, UnsupportedModelError, SimulationError, StorageError: as their messages say.
    """
    facts, state = load_checkpoint(checkpoint)
    saved = load_policy(checkpoint)
    if saved.epoch == 0:
        raise ConfigError(f"{checkpoint} is the untrained policy: wait for the first evaluation with a score")
    training = _training(saved, given)
    config, removed = _portable(saved.config)
    yield from removed
    payload, weights = _payload(saved, state, config)
    kept = {"epoch": saved.epoch, "score": facts.get("score", facts.get("best_score"))}
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / f"{target.name}.pt"
        write_checkpoint_file(draft, payload, kept)
        stored = replace(load_policy(draft), config=saved.config)  # here, the files that were removed exist
        difference = _parity(stored)
        yield f"exported, it differs by at most {difference:.0e} on {CHECKED} observations"
        worlds = saved.config.evaluation.nworld
        yield f"evaluating {len(seeds)} × {worlds} episodes on {device} ..."
        result = Bench(device).evaluate(stored, Request(seeds=tuple(seeds)))
        entry = Entry(
            env=config.env.name,
            sha256=stored.sha256,
            weights=weights,
            score=score_of(result),
            trained=training,
            packages={name: version for name, version in result["packages"].items() if name != "msk-ray"},
            config=config.as_dict(),
        )
        make_folder(target.parent)
        path = target.with_name(f"{target.name}.pt")
        write_bytes(path, draft.read_bytes())
    write_text(target.with_name(f"{target.name}.yaml"), dump_yaml(entry.model_dump()))
    score = entry.score
    yield f"{path}: {path.stat().st_size} bytes, score {score.mean:.5g} ± {score.std:.3g}, fell {score.fell:.0%}"
    yield _update_table(target.parent)


def _training(saved: SavedPolicy, given: Origin) -> Training:
    folder = trial_folder_of(saved.path)
    inner = folder.parent.name == "trials"
    recorded, damages = read_environment((folder.parent.parent if inner else folder) / ENVIRONMENT_FILE)
    if damages:
        raise StorageError(f"{damages[0]}; correct the file, or remove it and give --command, --commit and --machine")
    command = given.command or (_without_folders(recorded["command"]) if "command" in recorded else None)
    if command is not None and given.command is None and inner:
        trial = next((t for t in Experiment(folder.parent.parent).trials() if t.id == folder.name), None)
        command += f"  # trial {folder.name}" + (f": {trial.variant}, seed {trial.seed}" if trial is not None else "")
    machine = given.machine or _machine(folder, recorded, saved.config)
    commit = given.commit or recorded.get("commit")
    for name, value in (("command", command), ("commit", commit), ("machine", machine)):
        if not value:
            raise ConfigError(f"{folder} does not say with which {name} it was trained: add --{name} TEXT")
    chosen = given.chosen or (BEST_EVALUATION if saved.path.name == best_checkpoint_in(folder).name else None)
    if not chosen:
        raise ConfigError(
            f"{saved.path.name} is not the {best_checkpoint_in(folder).name} of its trial: say how it was chosen with "
            '--chosen TEXT, such as "the newest checkpoint"'
        )
    assert command is not None
    assert commit is not None
    assert machine is not None
    rows = [row for row in read_rows(folder) if row.get("epoch") == saved.epoch]
    return Training(
        command=command,
        commit=commit,
        machine=machine,
        chosen=chosen,
        epoch=saved.epoch,
        epochs=saved.config.trial.epochs,
        env_steps=saved.env_steps,
        seconds=round(rows[-1]["seconds"], 1) if rows else None,
        sha256=saved.sha256,
    )


def _without_folders(words: Sequence[str]) -> str:
    """A recorded command line, with file names in place of this machine's absolute paths."""
    return typed_command([words[0], *(Path(word).name if Path(word).is_absolute() else word for word in words[1:])])


def _machine(folder: Path, recorded: Mapping[str, Any], config: Config) -> str | None:
    """The GPUs of a trial, or `CPU`; None if it does not say."""
    name = recorded.get("device") or read_trial(folder).device.name
    if not name:
        return None
    return "CPU" if name == "cpu" else f"{config.execution.gpus} × {name}"


def _portable(config: Config) -> tuple[Config, list[str]]:
    """Settings without paths of this machine, and a line about each path that was left out.

    Raises:
        ConfigError: without such a path, the settings would mean something else.
    """
    paths = [key for key, value in flattened(config.as_dict()).items() if str(value).startswith("/")]
    for key in paths:
        # Neither changes what the policy acts in: MyoSuite's task has one model, wherever its package is.
        if key != "trial.start_from" and (key, config.env.name) != ("env.model", "myosuite_walk"):
            raise ConfigError(f"{key}: a path of this machine cannot go into a zoo; train with a relative one")
    portable = parse_recorded(overlay(config.as_dict(), dict.fromkeys(paths)), "the zoo's settings")
    return portable, [f"{key}: left out, being a path of this machine" for key in paths]


def _payload(saved: SavedPolicy, state: Mapping[str, Any], config: Config) -> tuple[bytes, Any]:
    """The policy alone, and how its weights are stored: as float16 if float32 is too large.

    Raises:
        ConfigError: it is too large as float16 too.
        CheckpointError: it does not record its sizes.
    """
    sizes = saved.sizes
    algorithm = algorithm_class(saved.config)
    parts = algorithm.policy_modules(algorithm.policy_network(saved.config, *sizes))
    modules = {name: state["algorithm"]["modules"][name] for name in parts}
    facts = {"config": config.as_dict(), "epoch": saved.epoch, "env_steps": saved.env_steps, "sizes": tuple(sizes)}
    room = MAX_BYTES - 2048  # for the head of the file
    for weights in ("float32", "float16"):
        buffer = io.BytesIO()
        torch.save({**facts, "algorithm": {"modules": modules}}, buffer)
        if len(buffer.getvalue()) <= room:
            return buffer.getvalue(), weights
        modules = {name: {key: _half_precision(value) for key, value in part.items()} for name, part in modules.items()}
    raise ConfigError(f"{saved.path}: its policy takes more than {MAX_BYTES} bytes; use a smaller actor.hidden")


def _half_precision(value: Any) -> Any:
    """A matrix of weights as float16. Vectors stay as they are, such as the statistics of observations: they are small
    and need more digits."""
    return (
        value.half() if isinstance(value, torch.Tensor) and value.dtype == torch.float32 and value.dim() > 1 else value
    )


def _parity(stored: SavedPolicy) -> float:
    """The largest difference between the stored policy and its export, on 1000 observations.

    Raises:
        ExportError: it is above the tolerance.
    """
    policy, env, _ = policy_to_control(stored, REFERENCE)
    seed = stored.config.evaluation.seed
    inputs = policy.examples(observations(env, seed), seed)
    return compare_with_checkpoint(policy, to_torchscript(policy, *inputs)[1], env, *inputs)


def _update_table(folder: Path) -> str:
    """Write the table of all entries between the marks in a zoo's README, if it has them."""
    path = folder / README
    text = zoo_text(read_zoo(folder))
    old = path.read_text(encoding="utf-8") if path.is_file() else ""
    if old.count(BEGIN) != 1 or old.count(END) != 1 or old.index(BEGIN) > old.index(END):
        return f"{path} has no place for the table ({BEGIN} ... {END}):\n\n{text}"
    write_text(path, f"{old[: old.index(BEGIN)]}{BEGIN}\n\n{text}\n\n{old[old.index(END) :]}")
    return f"{path}: table renewed"
