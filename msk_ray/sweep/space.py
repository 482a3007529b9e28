"""The search space file: a question, a base config, and what is varied in it."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationError

import msk_ray
from msk_ray.config import current_values, describe_fault, env_name, read_config, read_yaml
from msk_ray.config.sections import Count, Section, Text, Whole
from msk_ray.errors import ConfigError, brief
from msk_ray.sweep.operators import Listed, Operator, Range, parse_operator

Share = Annotated[float, Field(gt=0.0, lt=1.0)]
MAX_SEEDS = 100_000


class AblateSpec(Section):
    """One factor at a time: the baseline, and each variant laid over it. Keys are dotted config keys."""

    baseline: dict[str, Any] = Field(default_factory=dict)
    variants: Annotated[dict[str, dict[str, Any]], Field(min_length=1)]


class SchedulerSpec(Section):
    """Which trials are stopped early because others do better."""

    kind: Literal["asha", "median", "pbt", "none"] = "none"
    time_attr: Literal["env_steps", "epoch", "seconds"] = "env_steps"
    """What trials are compared at. Env steps is fair between horizons, and trials need not run in lockstep."""
    grace: Share = 0.25
    """Share of the longest trial's budget that no trial is stopped within: of the longest one that a search may
    suggest, an adaptive horizon counted with its `longest`. Too small a one loses slow starters."""
    reduction: Annotated[float, Field(ge=1.5, le=16)] = 3.0
    """asha: one in this many goes on past each rung; rungs are grace × reductionⁿ."""
    min_trials: Count | None = None
    """Trials that must have come as far before one is stopped; null is `reduction` rounded up (asha), 3 (median)."""
    interval: Share = 0.1
    """pbt: share of the budget between two exchanges."""
    quantile: Annotated[float, Field(gt=0.0, le=0.5)] = 0.25
    """pbt: this share of the worst trials goes on from the best ones."""
    resample: Annotated[float, Field(ge=0.0, le=1.0)] = 0.25
    """pbt: probability that an exchanged value is drawn anew instead of being moved by a fifth."""


class PlateauSpec(Section):
    """Stop a trial whose best score no longer rises."""

    patience: Count
    """Evaluations without a rise."""
    min_delta: Annotated[float, Field(ge=0.0)] = 0.0
    """What counts as a rise [score]."""
    grace: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.2
    """Share of the trial's epochs before which it is not stopped."""


class StopSpec(Section):
    """When a trial ends by itself before its last epoch."""

    nonfinite: bool = True
    """End a trial whose score or loss is NaN or infinite."""
    plateau: PlateauSpec | None = None
    wall_time_s: Annotated[float, Field(gt=0.0)] | None = None
    """Seconds of work a trial may take, over all its attempts."""
    target: float | None = None
    """Score at which a trial has done its work."""


class ResourcesSpec(Section):
    """What a trial gets, and how often it is tried again."""

    gpus_per_trial: Annotated[float, Field(gt=0.0)] = 1.0
    """GPUs of a trial where there are any; below 1, trials share one."""
    cpus_per_trial: Count = 1
    """CPU cores of a trial; at least its `trial.threads`."""
    max_concurrent: Count | None = None
    max_failures: Whole = 3
    """How often a trial whose process or node died goes on from its checkpoint."""
    hang_s: Annotated[float, Field(gt=0.0)] | None = 1800.0
    """Seconds without an epoch after which a trial's process is ended and tried again; null waits for ever."""
    halve_worlds_on_oom: bool = False
    """Start a trial that runs out of memory anew, once, with half its worlds."""


class SmokeSpec(Section):
    """What `--smoke` changes beyond the general rule."""

    overrides: dict[str, Any] = Field(default_factory=dict)
    max_trials: Count = 8


class SpaceFile(Section):
    """A search space as written."""

    question: Text
    """What the experiment is to answer."""
    base: Text
    """Config file, relative to the space file, the working directory, or the folder that holds `configs/`."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """Dotted config keys set in every trial."""
    parameters: dict[str, Any] = Field(default_factory=dict)
    """Dotted config keys that are varied, each with one operator."""
    ablate: AblateSpec | None = None
    seeds: str | int | list[int] = "0"
    """Seeds every trial is run with: "0-4", "0,3", 7 or [0, 3]."""
    max_trials: Count = 2000
    """Most trials the space may make; more are refused before any is made."""
    samples: Count = 1
    """Draws of the sampled parameters (choice, uniform, loguniform, randint), for each point of the grid."""
    sample_seed: Whole = 0
    """Seed of those draws."""
    search: Literal["random", "optuna"] = "random"
    scheduler: SchedulerSpec = SchedulerSpec()
    stop: StopSpec = StopSpec()
    resources: ResourcesSpec = ResourcesSpec()
    smoke: SmokeSpec = SmokeSpec()


class Space(Section):
    """A checked search space, with its operators and seeds read."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    name: str
    file: SpaceFile
    base_path: Path
    parameters: dict[str, Operator]
    seeds: tuple[int, ...]

    @property
    def sampled(self) -> dict[str, Operator]:
        """The parameters that are drawn rather than enumerated."""
        return {k: op for k, op in self.parameters.items() if isinstance(op, Range) or op.kind == "choice"}

    @property
    def grids(self) -> dict[str, Listed]:
        """The parameters whose values are all tried."""
        return {k: op for k, op in self.parameters.items() if isinstance(op, Listed) and op.kind == "grid"}


def find_space(name: str) -> Path:
    """The file a space's name or path means: as given, in `tune_spaces/` here, or beside the package.

    Raises:
        ConfigError: there is none; the message lists those there are.
    """
    folders = [Path.cwd() / "tune_spaces", _repository() / "tune_spaces"]
    if name.endswith((".yaml", ".yml")) or "/" in name:
        path = Path(name)
        if not path.is_file():
            raise ConfigError(f"no such space file: {name}")
        return path.resolve()
    for folder in folders:
        if (folder / f"{name}.yaml").is_file():
            return (folder / f"{name}.yaml").resolve()
    known = sorted({path.stem for folder in folders for path in folder.glob("*.yaml")})
    raise ConfigError(f"unknown space {name!r}; known: {', '.join(known) or 'none'}, or give a path to a .yaml file")


def load_space(path: Path) -> Space:
    """Read and check a space file.

    Raises:
        ConfigError: as `parse_space`, or the file cannot be read.
    """
    return parse_space(read_space(path), path)


def read_space(path: Path) -> dict[str, Any]:
    """The plain data of a space file, in today's spelling.

    Raises:
        ConfigError: it or its base cannot be read.
    """
    data = read_yaml(path)
    if not isinstance(data.get("base"), str):
        return data  # and is refused for that
    try:
        name = env_name(read_config(_find_base(data["base"], path)))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None

    def current(values: Any) -> Any:
        return current_values(values, name) if isinstance(values, dict) else values

    data |= {part: current(data[part]) for part in ("overrides", "parameters") if part in data}
    ablate, smoke = data.get("ablate"), data.get("smoke")
    if isinstance(smoke, dict) and "overrides" in smoke:
        data["smoke"] = smoke | {"overrides": current(smoke["overrides"])}
    if isinstance(ablate, dict):
        data["ablate"] = ablate = {part: current(values) for part, values in ablate.items()}
        if isinstance(variants := ablate.get("variants"), dict):
            ablate["variants"] = {label: current(values) for label, values in variants.items()}
    return data


def parse_space(data: Mapping[str, Any], path: Path) -> Space:
    """Check a space's plain data. `path` names it in errors and anchors its `base`.

    Raises:
        ConfigError: with the first fault on one line.
    """
    try:
        file = SpaceFile.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe_fault(error, SpaceFile)}") from None
    try:
        parameters = {key: parse_operator(key, value) for key, value in file.parameters.items()}
        _check_count(file, parameters)
        seeds = parse_seeds(file.seeds)
        _check_combination(file, parameters, seeds)
        base_path = _find_base(file.base, path)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return Space(name=path.stem, file=file, base_path=base_path, parameters=parameters, seeds=seeds)


def parse_seeds(text: str | int | list[int]) -> tuple[int, ...]:
    """Seeds written as "0-4", "0,3,10-12", 7 or [0, 3], in order and without repeats.

    Raises:
        ConfigError: not such a list.
    """
    seeds: dict[int, None] = {}
    ranges = _seed_ranges(text)
    if (count := sum(last - first + 1 for first, last in ranges)) > MAX_SEEDS:
        raise ConfigError(f"seeds {brief(text)}: {count} seeds, more than {MAX_SEEDS}")
    for first, last in ranges:
        seeds.update(dict.fromkeys(range(first, last + 1)))
    return tuple(seeds)


def _seed_ranges(text: str | int | list[int]) -> list[tuple[int, int]]:
    """(first, last) of each piece of a list of seeds; nothing is written out."""
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
    """Refuse a space of more than `max_trials`, counted before a single one is made."""
    seeds = sum(last - first + 1 for first, last in _seed_ranges(file.seeds))
    grids = [len(op.levels) for op in parameters.values() if isinstance(op, Listed) and op.kind == "grid"]
    variants = len(file.ablate.variants) + 1 if file.ablate is not None else file.samples * math.prod(grids)
    if variants * seeds > file.max_trials:
        raise ConfigError(
            f"{variants} variants × {seeds} seeds are {variants * seeds} trials, more than max_trials "
            f"{file.max_trials}: take some away, or write a larger max_trials in the space"
        )


def _check_combination(file: SpaceFile, parameters: Mapping[str, Operator], seeds: tuple[int, ...]) -> None:
    """Refuse settings that are each fine and make no sense together."""
    grids = [key for key, op in parameters.items() if isinstance(op, Listed) and op.kind == "grid"]
    sampled = [key for key in parameters if key not in grids]
    if "trial.seed" in parameters:
        raise ConfigError("parameters.trial.seed: seeds are an axis of their own; write seeds: 0-4")
    if file.ablate is not None and parameters:
        raise ConfigError("ablate varies one factor at a time; drop parameters, or write the factors as grids there")
    if file.samples > 1 and not sampled:
        raise ConfigError("samples: nothing is drawn; give a parameter choice, uniform, loguniform or randint")
    if file.search == "optuna":
        if grids:
            raise ConfigError(f"parameters.{grids[0]}.grid: search: optuna cannot enumerate; write choice instead")
        if not sampled:
            raise ConfigError("search: optuna needs parameters with choice, uniform, loguniform or randint")
        if len(seeds) > 1:
            raise ConfigError("search: optuna runs every suggestion once; give a single seed")
    if file.scheduler.time_attr == "seconds" and file.scheduler.kind != "none" and file.stop.wall_time_s is None:
        raise ConfigError("scheduler.time_attr: seconds needs stop.wall_time_s, the budget that grace is a share of")
    if file.scheduler.kind == "pbt":
        if not any(isinstance(parameters[key], Range) for key in sampled):
            raise ConfigError("scheduler.kind: pbt needs a parameter with a range to move in (uniform, loguniform)")
        if file.resources.halve_worlds_on_oom:
            raise ConfigError(
                "resources.halve_worlds_on_oom (--halve-worlds): pbt hands the states of all worlds from one trial to "
                "another, so all need as many; write false"
            )
        if file.search == "optuna":
            raise ConfigError("scheduler.kind: pbt chooses values itself; write search: random")


def _find_base(base: str, space_path: Path) -> Path:
    candidates = [space_path.parent / base, Path.cwd() / base, space_path.parent.parent / base, _repository() / base]
    for candidate in candidates:
        if candidate.is_file():
            return candidate.resolve()
    raise ConfigError(f"base: no such config file: {base}")


def _repository() -> Path:
    """The folder the package lies in; in a checkout it also holds `configs/` and `tune_spaces/`."""
    return Path(msk_ray.__file__).resolve().parent.parent
