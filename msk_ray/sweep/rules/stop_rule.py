"""The base class of rules that end a trial by its own history alone."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, cast

from pydantic import (
    ModelWrapValidatorHandler,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)
from pydantic_core import InitErrorDetails

from msk_ray.config.sections import Section
from msk_ray.experiment.metrics import Evaluation
from msk_ray.experiment.outcomes import Outcome


@dataclass(frozen=True)
class History:
    """A trial's history after an epoch."""

    row: Mapping[str, float]
    """Metrics of the last epoch."""
    evaluations: Sequence[Evaluation]
    """All evaluations of the trained policy, the newest last."""
    epochs: int
    """The trial's full length."""
    elapsed_s: float
    """Training time so far, over all attempts [s]."""

    @property
    def epoch(self) -> int:
        """Epochs done."""
        return int(self.row["epoch"])


class StopRule(Section, ABC):
    """A rule with its settings, which are the fields of its class.

    To write your own, derive a class from this one, and name its import path in a space:
    `stop: {rules: {"package.module:Class": {setting: value}}}`.
    """

    outcome: ClassVar[Outcome] = Outcome.STOPPED_RULE
    """Outcome of trials that it stops."""
    by_score: ClassVar[bool] = True
    """Whether it decides by scores; if so, --no-early-stopping and --smoke disable it."""
    before_the_end: ClassVar[bool] = False
    """Whether it is also checked after the last epoch, whose outcome it then replaces."""
    shorthand: ClassVar[str | None] = None
    """The setting that a bare value sets: `target: 5` means `target: {score: 5}`."""

    @abstractmethod
    def why(self, history: History) -> str | None:
        """Why the trial ends now, as text; None to continue."""

    @model_validator(mode="wrap")
    @classmethod
    def _from_a_bare_value(cls, data: Any, handler: ModelWrapValidatorHandler["StopRule"]) -> "StopRule":
        if cls.shorthand is None or isinstance(data, Mapping | StopRule):
            return handler(data)
        try:
            return handler({cls.shorthand: data})
        except ValidationError as error:
            # The file has no such key; report the error at the bare value.
            faults = cast(list[InitErrorDetails], [fault | {"loc": fault["loc"][1:]} for fault in error.errors()])
            raise ValidationError.from_exception_data(cls.__name__, faults) from None

    @model_serializer(mode="wrap")
    def _as_a_bare_value(self, handler: SerializerFunctionWrapHandler) -> Any:
        written = handler(self)
        return written[self.shorthand] if self.shorthand is not None and set(written) == {self.shorthand} else written
