"""The `stop` section of a space: the rules that end its trials."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, SerializeAsAny, ValidationError, model_validator

from msk_ray.config import Registry, describe_fault, resolve_class
from msk_ray.config.sections import Section
from msk_ray.errors import ConfigError
from msk_ray.experiment.outcomes import Ending, Outcome
from msk_ray.sweep.rules.nonfinite import NonFinite
from msk_ray.sweep.rules.plateau import Plateau
from msk_ray.sweep.rules.stop_rule import History, StopRule
from msk_ray.sweep.rules.target import Target
from msk_ray.sweep.rules.wall_time import WallTime

STOP_RULES = Registry("stop.rules", "msk_ray.stop_rules", {})
"""Rules of installed packages, by entry point; the package's own rules are fields of the section."""


def _from_outside(value: Any) -> Any:
    """Rules from outside, by name or import path."""
    if not isinstance(value, Mapping):
        return value
    return {name: _rule(name, settings) for name, settings in value.items()}


def _rule(name: Any, settings: Any) -> StopRule:
    if isinstance(settings, StopRule):
        return settings
    try:
        # mypy does not accept an abstract class as type[T].
        kind = resolve_class(STOP_RULES.path(name), f"stop.rules.{name}", StopRule)  # type: ignore[type-abstract]
    except ConfigError as error:
        raise ValueError(str(error)) from error
    try:
        return kind.model_validate({} if settings is None else settings)
    except ValidationError as error:
        raise ValueError(f"stop.rules.{name}: {describe_fault(error, kind)}") from error


class StopSpec(Section):
    """Rules by which a trial ends before its last epoch."""

    nonfinite: NonFinite | None = NonFinite()
    """Written as true or false."""
    target: Target | None = None
    wall_time_s: WallTime | None = None
    plateau: Plateau | None = None
    rules: Annotated[dict[str, SerializeAsAny[StopRule]], BeforeValidator(_from_outside)] = Field(default_factory=dict)
    """Your own rules: import path, or name of an installed rule → its settings."""

    @model_validator(mode="before")
    @classmethod
    def _switch(cls, data: Any) -> Any:
        if not isinstance(data, dict) or not isinstance(data.get("nonfinite"), bool):
            return data
        return data | {"nonfinite": {} if data["nonfinite"] else None}

    def all_rules(self) -> list[StopRule]:
        """The active rules, in the order in which they are checked: that of the fields, and then users' own."""
        return [rule for _, rule in self if isinstance(rule, StopRule)] + list(self.rules.values())

    def without_scores(self) -> "StopSpec":
        """The rules that do not decide by scores."""
        left_out = {name: None for name, rule in self if isinstance(rule, StopRule) and rule.by_score}
        kept = {name: rule for name, rule in self.rules.items() if not rule.by_score}
        return self.model_copy(update=left_out | ({"rules": kept} if kept != self.rules else {}))

    def ending(self, history: History) -> Ending | None:
        """The ending of a trial after an epoch; None to continue."""
        finished = history.epoch >= history.epochs
        for rule in sorted(self.all_rules(), key=lambda rule: not rule.before_the_end):
            if finished and not rule.before_the_end:
                break
            why = rule.why(history)
            if why is not None:
                return Ending(rule.outcome, why)
        return Ending(Outcome.FINISHED, f"all {history.epochs} epochs done") if finished else None
