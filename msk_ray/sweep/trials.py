"""From a space to its trials: resolves every combination, validates its config, and computes its id."""

import difflib
import itertools
import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from msk_ray.config import Config, leaves, overlay, parse_config, read_config, refuse_ignored
from msk_ray.errors import ConfigError
from msk_ray.experiment.trial import ID_DIGITS, Trial, trial_id, variant_text, with_epochs
from msk_ray.sweep.operators import Level, NamedValues, Operator
from msk_ray.sweep.rules.scheduler import refuse_several
from msk_ray.sweep.space import Space


def resolve_trials(space: Space) -> list[Trial]:
    """All trials of an enumerable space, in the order in which they start: every variant with the first seed, then
    every variant with the next.

    Raises:
        ConfigError: a setting is unknown or invalid, two parameters set the same key, two trials are equal, or the
            scheduler does not support several environments.
    """
    base = base_settings(space)
    check_ranges(space, base)
    variants = list(_variants(space))
    trials = [
        make_trial(space, base, changed, values, seed, index)
        for index, (seed, (changed, values)) in enumerate(itertools.product(space.seeds, variants))
    ]
    check_algorithms_read(space, (trial.config for trial in trials))
    if space.file.scheduler.exchanges:
        kind = space.file.scheduler.kind
        refuse_several(
            (trial.environment for trial in trials),
            f"{space.name}: scheduler.kind: {kind} lets trials continue from better ones",
        )
    by_id: dict[str, Trial] = {}
    for trial in trials:
        twin = by_id.setdefault(trial.id, trial)
        if twin is not trial:
            raise ConfigError(
                f"{space.name}: {trial.variant!r} and {twin.variant!r} (seed {trial.seed}) come out as the same trial; "
                "drop one of them"
            )
    return trials


def base_settings(space: Space) -> dict[str, Any]:
    """The space's base config with its overrides, as nested plain data, validated.

    Raises:
        ConfigError: the base cannot be read, or is not a valid config.
    """
    settings = overlay(read_config(space.base_path), space.file.overrides)
    parse_config(settings, f"{space.name}: {space.base_path.name} with the space's overrides")
    return settings


def make_trial(
    space: Space, base: Mapping[str, Any], changed: dict[str, str], values: dict[str, Any], seed: int, index: int
) -> Trial:
    """The trial of the base settings with `values` (dotted key → value) and a seed.

    Raises:
        ConfigError: the result is not a valid config.
    """
    name = f"{space.name}: trial {index} ({variant_text(changed)})"
    config = parse_config(overlay(overlay(base, values), {"trial.seed": seed}), name)
    return Trial(index, trial_id(config), dict(changed), dict(values), config)


def with_recorded_ids(planned: Sequence[Trial], recorded: Sequence[Trial]) -> list[Trial]:
    """Planned trials, with the ids under which the same trials are recorded.

    Recorded ids differ after an extension, which changes epochs but not ids, and in experiments of version 0.2, which
    hashed all settings.
    """
    one_length = len({trial.epochs for trial in recorded}) == 1 == len({trial.epochs for trial in planned})

    def content(trial: Trial) -> str:
        return trial_id(with_epochs(trial, 1).config if one_length else trial.config)

    ids = {trial.id for trial in recorded}
    by_content = {content(trial): trial.id for trial in recorded}
    return [
        trial if trial.id in ids else replace(trial, id=by_content.get(content(trial), trial.id)) for trial in planned
    ]


def check_ranges(space: Space, base: Mapping[str, Any]) -> None:
    """Validate both ends of every range in advance, so that no later draw is invalid.

    Other parameters have their first level or lower end.

    Raises:
        ConfigError: naming the parameter and the end.
    """
    first = {key: op.extremes()[0].value for key, op in space.parameters.items()}
    for key, op in space.parameters.items():
        for end in op.check():
            name = f"{space.name}: {key} {type(op).__name__.lower()} at its end {end.label}"
            parse_config(overlay(base, first | {key: end.value}), name)
    _check_collisions(space)


def check_algorithms_read(space: Space, configs: Iterable[Config]) -> None:
    """Refuse settings of a space that no trial's algorithm uses.

    Args:
        space: the space.
        configs: its trials' configs, or one for each algorithm that a search can choose.

    Raises:
        ConfigError: naming the setting.
    """
    configs = list({config.algorithm.name: config for config in configs}.values())
    file, ablate = space.file, space.file.ablate
    refuse_ignored(file.overrides, configs, f"{space.name}: overrides:")
    for key, op in space.parameters.items():
        for level in op.extremes():
            refuse_ignored({key: level.value}, configs, f"{space.name}: parameters:")
    if ablate is not None:
        for values in (ablate.baseline, *ablate.variants.values()):
            refuse_ignored(values, configs, f"{space.name}: ablate:")


def _variants(space: Space) -> Iterator[tuple[dict[str, str], dict[str, Any]]]:
    """(labels, values) of every variant, without seeds."""
    if space.file.ablate is not None:
        for point in grid_points(space.grids):
            labels = {key: level.label for key, level in point.items()}
            values = {key: level.value for key, level in point.items()}
            for label, changes in _ablations(space):
                yield {**labels, **label}, {**values, **changes}
        return
    rng = random.Random(space.file.sample_seed)
    # Draws are the outer loop, so that more samples append trials and keep the earlier ones.
    for _ in range(space.file.samples):
        for point in grid_points(space.grids):
            drawn = {key: op.draw(rng) for key, op in space.sampled.items()}
            levels = {key: (point | drawn)[key] for key in space.parameters}
            yield {key: level.label for key, level in levels.items()}, {k: level.value for k, level in levels.items()}


def grid_points(grids: Mapping[str, Operator]) -> Iterator[dict[str, Level]]:
    """Every combination of the grids' levels; the last parameter varies fastest."""
    for combination in itertools.product(*(op.levels for op in grids.values())):
        yield dict(zip(grids, combination, strict=True))


def _ablations(space: Space) -> Iterator[tuple[dict[str, str], dict[str, Any]]]:
    ablate = space.file.ablate
    assert ablate is not None
    yield {"variant": ablate.label}, dict(ablate.baseline)
    for name, changes in ablate.variants.items():
        yield {"variant": name}, {**ablate.baseline, **changes}


def _check_collisions(space: Space) -> None:
    """Refuse parameters that set the same config key, and values of a parameter with the same label."""
    owner: dict[str, str] = {}
    for key, op in space.parameters.items():
        values: dict[str, Any] = {}
        for level in op.levels if isinstance(op, NamedValues) else ():
            if values.setdefault(level.label, level.value) != level.value:
                raise ConfigError(
                    f"{space.name}: parameters.{key}: two values are both shown as {level.label}; give each a label: "
                    "{label: NAME, value: VALUE}"
                )
        for leaf in sorted({leaf for level in op.extremes() for leaf, _ in leaves(key, level.value)}):
            other = owner.setdefault(leaf, key)
            if other != key:
                raise ConfigError(f"{space.name}: parameters {other!r} and {key!r} both set {leaf}")
    if space.file.ablate is None:
        return
    for name, changes in _ablations(space):
        for leaf in sorted({leaf for key, value in changes.items() for leaf, _ in leaves(key, value)}):
            if leaf in owner:
                raise ConfigError(f"{space.name}: parameter {owner[leaf]!r} and {name['variant']!r} both set {leaf}")


def find_trial(trials: list[Trial], text: str) -> Trial:
    """The trial with this number, or with an id that begins with this text.

    Raises:
        ConfigError: there is no such trial, or more than one.
    """
    if text.isdecimal() and len(text) < ID_DIGITS and int(text) < len(trials):
        return trials[int(text)]
    matches = [trial for trial in trials if trial.id.startswith(text)]
    if len(matches) == 1:
        return matches[0]
    near = difflib.get_close_matches(text, [trial.id for trial in trials], n=1)
    hint = f"did you mean {near[0]}?" if near else f"give 0 to {len(trials) - 1}, or an id from --dry-run"
    raise ConfigError(f"no trial {text!r}; {hint}")
