"""The search space file: a question, a base config, and what to vary."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, SerializeAsAny, ValidationError, model_validator

from msk_ray.config import current_space, current_values, describe_fault, leaves, read_yaml
from msk_ray.config.sections import Count, Section, Text, Whole
from msk_ray.errors import ConfigError, brief
from msk_ray.experiment.manifest import MAX_TRIALS
from msk_ray.shipped import CONFIGS, SPACES, find_shipped, is_name, shipped_names
from msk_ray.sweep.operators import Operator, Range, parse_operator
from msk_ray.sweep.rules import RECORDED, read_scheduler, scheduler_class
from msk_ray.sweep.rules.scheduler import NoScheduler, SchedulerSpec
from msk_ray.sweep.rules.stopping import StopSpec
from msk_ray.sweep.search import search_class

MAX_SEEDS = 100_000


class AblateSpec(Section):
    """Varies one factor at a time: runs the baseline, and each variant merged into it. Keys are dotted config keys.

    With grids beside it, all of these run at every grid point.
    """

    label: Text = "baseline"
    """Name of the baseline in tables."""
    baseline: dict[str, Any] = Field(default_factory=dict)
    variants: Annotated[dict[str, dict[str, Any]], Field(min_length=1)]

    @model_validator(mode="after")
    def _names_differ(self) -> "AblateSpec":
        if self.label in self.variants:
            raise ValueError(f"the baseline and a variant are both called {self.label}; give ablate.label another name")
        return self


class ResourcesSpec(Section):
    """Resources of a trial, and how failures are handled."""

    gpus_per_trial: Annotated[float, Field(gt=0.0)] = 1.0
    """GPUs per trial if there are any; below 1, trials share a GPU."""
    cpus_per_trial: Count = 1
    """CPU cores per trial; at least its `execution.threads`."""
    max_concurrent: Count | None = None
    max_failures: Whole = 3
    """How often to retry a trial from its checkpoint after its process or node has died."""
    hang_s: Annotated[float, Field(gt=0.0)] | None = 1800.0
    """Time without an epoch after which a trial's process is killed and restarted [s]; null: wait forever."""
    halve_worlds_on_oom: bool = False
    """Restart a trial that runs out of memory once, from the beginning, with half its worlds."""


class SpaceFile(Section):
    """The content of a search space file."""

    question: Text
    """The question that the experiment answers."""
    base: Text
    """Config file: relative to the space file or its parent folder, or as `load_config` finds it."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """Dotted config keys set in every trial."""
    parameters: dict[str, Any] = Field(default_factory=dict)
    """Dotted config keys that are varied, each with one operator."""
    ablate: AblateSpec | None = None
    seeds: str | int | list[int] = "0"
    """Seeds of every variant: "0-4", "0,3", 7 or [0, 3]."""
    max_trials: Annotated[Count, Field(le=MAX_TRIALS)] = 2000
    """Largest number of trials; a space with more is refused before any trial is created."""
    samples: Count = 1
    """Random draws of the sampled parameters (choice, uniform, loguniform, randint) per grid point."""
    sample_seed: Whole = 0
    """Seed of these draws, of a search, and of pbt's exchanges."""
    search: Text = "random"
    """`random`: draw all trials in advance. Otherwise the search that suggests them, by name or import path."""
    objectives: dict[Text, Literal["minimize", "maximize"]] = Field(default_factory=dict)
    """What a search optimises instead of the score: metrics of the last evaluation, such as eval/fall_rate."""
    scheduler: Annotated[SerializeAsAny[SchedulerSpec], BeforeValidator(read_scheduler)] = NoScheduler()
    stop: StopSpec = StopSpec()
    resources: ResourcesSpec = ResourcesSpec()

    @property
    def searches(self) -> bool:
        """Whether trials are suggested one by one as results arrive, instead of known in advance."""
        return self.search != "random"


class Space(Section):
    """A checked search space, with parsed operators and seeds."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    name: str
    file: SpaceFile
    base_path: Path
    parameters: dict[str, Operator]
    seeds: tuple[int, ...]

    @property
    def sampled(self) -> dict[str, Operator]:
        """Parameters that are drawn."""
        return {key: op for key, op in self.parameters.items() if not op.enumerated}

    @property
    def grids(self) -> dict[str, Operator]:
        """Parameters that are enumerated."""
        return {key: op for key, op in self.parameters.items() if op.enumerated}


def find_space(name: str) -> Path:
    """The space file with this path, or of this name in `tune_spaces/` of the current folder or of the package.

    Raises:
        ConfigError: there is none; the message lists the known spaces.
    """
    path = find_shipped(name, SPACES, ".yaml")
    if path is not None:
        return path
    if not is_name(name):
        raise ConfigError(f"no such space file: {name}")
    known = ", ".join(shipped_names(SPACES, ".yaml"))
    raise ConfigError(f"unknown space {name!r}; known: {known}, or give a path to a .yaml file")


def load_space(path: Path) -> Space:
    """Read and check a space file.

    Raises:
        ConfigError: as for `parse_space`, or the file cannot be read.
    """
    return parse_space(read_space(path), path)


def recorded_space(path: Path) -> Space:
    """Read and check the space recorded by an experiment.

    Raises:
        ConfigError: as for `load_space`.
    """
    return parse_space(read_space(path), path, recorded=True)


def read_space(path: Path) -> dict[str, Any]:
    """The plain data of a space file, in the current spelling.

    Raises:
        ConfigError: it cannot be read, or has a removed setting.
    """
    data = current_space(read_yaml(path))

    def current(values: Any) -> Any:
        return current_values(values) if isinstance(values, dict) else values

    data |= {part: current(data[part]) for part in ("overrides", "parameters") if part in data}
    ablate = data.get("ablate")
    if isinstance(ablate, dict):
        data["ablate"] = ablate = {part: current(values) for part, values in ablate.items()}
        if isinstance(variants := ablate.get("variants"), dict):
            ablate["variants"] = {label: current(values) for label, values in variants.items()}
    return data


def read_file(data: Any, source: str, *, recorded: bool = False) -> SpaceFile:
    """Check a space's plain data without its base. `source` names it in errors.

    Args:
        recorded: whether the data is an experiment's record, perhaps of an earlier version.

    Raises:
        ConfigError: with the first error on one line.
    """
    try:
        return SpaceFile.model_validate(data, context=RECORDED if recorded else None)
    except ValidationError as error:
        raise ConfigError(f"{source}: {describe_fault(error, SpaceFile, named=_named(data))}") from None


def _named(data: Any) -> dict[str, type[BaseModel]]:
    """Settings classes of the sections that name a class, where that is valid."""
    scheduler = data.get("scheduler") if isinstance(data, Mapping) else None
    try:
        return {"scheduler": scheduler_class(scheduler.get("kind"))} if isinstance(scheduler, Mapping) else {}
    except ConfigError:
        return {}  # the invalid name is reported by its own check


def parse_space(data: Mapping[str, Any], path: Path, *, recorded: bool = False) -> Space:
    """Check a space's plain data. `path` names it in errors, and its `base` is relative to it.

    Raises:
        ConfigError: with the first error on one line.
    """
    file = read_file(data, str(path), recorded=recorded)
    try:
        parameters = {key: parse_operator(key, value) for key, value in file.parameters.items()}
        _check_count(file, parameters)
        seeds = parse_seeds(file.seeds)
        if not recorded:
            _check_seeds(file, parameters)
        _check_combination(file, parameters, seeds)
        base_path = _find_base(file.base, path)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return Space(name=path.stem, file=file, base_path=base_path, parameters=parameters, seeds=seeds)


def parse_seeds(text: str | int | list[int]) -> tuple[int, ...]:
    """Seeds written as "0-4", "0,3,10-12", 7 or [0, 3], in order and without repeats.

    Raises:
        ConfigError: not a valid list of seeds.
    """
    seeds: dict[int, None] = {}
    ranges = _seed_ranges(text)
    if (count := sum(last - first + 1 for first, last in ranges)) > MAX_SEEDS:
        raise ConfigError(f"seeds {brief(text)}: {count} seeds, more than {MAX_SEEDS}")
    for first, last in ranges:
        seeds.update(dict.fromkeys(range(first, last + 1)))
    return tuple(seeds)


def _seed_ranges(text: str | int | list[int]) -> list[tuple[int, int]]:
    """(first, last) of each part of a list of seeds, without expanding it."""
    pieces = [str(piece) for piece in text] if isinstance(text, list) else str(text).split(",")
    ranges = []
    for piece in pieces:
        match = re.fullmatch(r"\s*(\d{1,10})(?:\s*-\s*(\d{1,10}))?\s*", piece)
        if match is None or max(int(match[1]), int(match[2] or 0)) >= 2**31:
            raise ConfigError(f"seeds {brief(text)}: write whole numbers such as 0-4 or 0,3,7, below 2^31")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ConfigError(f"seeds {brief(text)}: {first}-{last} runs backwards; write {last}-{first}")
        ranges.append((first, last))
    return ranges


def _check_count(file: SpaceFile, parameters: Mapping[str, Operator]) -> None:
    """Raise if a space has more than `max_trials` trials, before creating any."""
    seeds = sum(last - first + 1 for first, last in _seed_ranges(file.seeds))
    grids = [len(op.levels) for op in parameters.values() if op.enumerated]
    variants = math.prod(grids) * (file.samples if file.ablate is None else len(file.ablate.variants) + 1)
    if variants * seeds > file.max_trials:
        raise ConfigError(
            f"{variants} variants × {seeds} seeds are {variants * seeds} trials, more than max_trials "
            f"{file.max_trials}: remove some, or write a larger max_trials in the space"
        )


def _check_seeds(file: SpaceFile, parameters: Mapping[str, Operator]) -> None:
    """Raise if a space sets `trial.seed`, which the section `seeds` would replace."""
    places = [("overrides", file.overrides)]
    places += [("parameters", {key: level.value}) for key, op in parameters.items() for level in op.extremes()]
    if file.ablate is not None:
        places.append(("ablate.baseline", file.ablate.baseline))
        places += [(f"ablate.variants.{name}", values) for name, values in file.ablate.variants.items()]
    for place, values in places:
        if any(leaf == "trial.seed" for key, value in values.items() for leaf, _ in leaves(key, value)):
            raise ConfigError(
                f"{place}.trial.seed: seeds have their own section; write seeds: 0-4 (--seeds 0-4 on the command line)"
            )


def _check_combination(file: SpaceFile, parameters: Mapping[str, Operator], seeds: tuple[int, ...]) -> None:
    """Raise for settings that are valid separately but not together."""
    sampled = {key: op for key, op in parameters.items() if not op.enumerated}
    if file.ablate is not None and (sampled or file.searches):
        raise ConfigError("ablate varies one factor at a time: beside it write only grids, and search: random")
    if file.samples > 1 and not sampled:
        raise ConfigError("samples: nothing is drawn; give a parameter choice, uniform, loguniform or randint")
    if file.objectives and not (file.searches and search_class(file.search).several_objectives):
        raise ConfigError(f"objectives: search: {file.search} looks for none; write search: optuna, or leave them out")
    if file.searches:
        search_class(file.search).check(parameters, seeds)
    file.scheduler.check(file, [key for key, op in sampled.items() if isinstance(op, Range)])


def _find_base(base: str, space_path: Path) -> Path:
    beside, cwd, above = space_path.parent / base, Path.cwd() / base, space_path.parent.parent / base
    for candidate in (beside, cwd, above):
        if candidate.is_file():
            return candidate.resolve()
    shipped = find_shipped(base, CONFIGS, ".yaml")
    if shipped is None:
        raise ConfigError(f"base: no such config file: {base}")
    return shipped
