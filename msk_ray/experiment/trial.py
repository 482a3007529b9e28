"""One trial of an experiment: its id, its varied settings, and its full settings."""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from msk_ray.config import SCHEMA, Config, changed_settings, flattened
from msk_ray.text import describe, printable

T = TypeVar("T")

ID_DIGITS = 8


@dataclass(frozen=True)
class Trial:
    """One training run of an experiment."""

    index: int
    """Position in the experiment, from 0."""
    id: str
    """Hash of what is trained, seed included; the name of the trial's folder."""
    changed: dict[str, str]
    """The varied settings of this trial, parameter → value as text, without the seed."""
    values: dict[str, Any]
    """The same as data: dotted key → value."""
    config: Config

    @property
    def seed(self) -> int:
        return self.config.trial.seed

    @property
    def epochs(self) -> int:
        return self.config.trial.epochs

    @property
    def environment(self) -> str:
        """Name of its environment. Scores of different environments are not comparable."""
        return self.config.env.name

    @property
    def variant(self) -> str:
        """The changed parameters on one line; equal for all seeds of a variant."""
        return variant_text(self.changed)

    @property
    def label(self) -> str:
        """Id, changed parameters and seed on one printable line, for Ray's lists and profiles."""
        # Profiles separate frames by semicolons.
        return printable(f"{self.id} {self.variant} seed={self.seed}").replace(";", ",")


def by_environment(items: Iterable[T], environment: Callable[[T], str]) -> dict[str, list[T]]:
    """Items by environment name, in the order given."""
    groups: dict[str, list[T]] = {}
    for item in items:
        groups.setdefault(environment(item), []).append(item)
    return groups


def variant_text(changed: Mapping[str, str]) -> str:
    """`actor_lr=0.002, horizon=16, hard friction`: keys without sections; for whole sections only the label."""
    parts = [f"{short_key(key)}={value}" if "." in key else value for key, value in changed.items()]
    return ", ".join(parts) or "base"


def short_key(key: str) -> str:
    """A dotted key without its sections: `shac.actor_lr` → `actor_lr`; `algorithm.name` → `algorithm`."""
    section, _, leaf = key.rpartition(".")
    return section if leaf == "name" else leaf


def trial_id(config: Config) -> str:
    """First digits of the SHA-256 of all settings that differ from their defaults, except `execution`. The same
    training has the same id on every machine, and in every version with the same `SCHEMA`."""
    trained = {name: value for name, value in changed_settings(config).items() if name != "execution"}
    text = json.dumps({"schema": SCHEMA, **trained}, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:ID_DIGITS]


def with_epochs(trial: Trial, epochs: int) -> Trial:
    """The same trial, with the same id, but another number of epochs."""
    longer = trial.config.trial.model_copy(update={"epochs": epochs})
    return replace(trial, config=trial.config.model_copy(update={"trial": longer}))


def describe_changes(old: Config, new: Config) -> str:
    """`shac.actor_lr 0.002 → 0.001, …`: the settings in which two configs differ."""
    before, after = flattened(old.as_dict()), flattened(new.as_dict())
    keys = [key for key in {**before, **after} if before.get(key) != after.get(key)]
    return ", ".join(f"{key} {describe(before.get(key))} → {describe(after.get(key))}" for key in keys)
