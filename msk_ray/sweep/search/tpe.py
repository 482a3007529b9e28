"""Optuna's tree-structured Parzen estimator."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from msk_ray.errors import ConfigError
from msk_ray.sweep.operators import NamedValues, Operator, Range
from msk_ray.sweep.search.base import Search


class OptunaSearch(Search):
    """Suggests values that resemble the better part of those tried; with several objectives, the Pareto-optimal trials
    count as best."""

    packages: ClassVar[Mapping[str, str]] = {"optuna": "msk-ray[optuna]"}
    name = "optuna"
    several_objectives = True

    def __init__(
        self, parameters: Mapping[str, Operator], seed: int, objectives: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(parameters, seed)
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._distributions = {key: distribution(key, op) for key, op in self.parameters.items()}
        directions = [*objectives.values()] if objectives else ["maximize"]
        self._study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed), directions=directions)
        self._open: list[Any] = []

    def ask(self) -> dict[str, Any]:
        trial = self._study.ask(self._distributions)
        self._open.append(trial)
        return dict(trial.params)

    def tell(self, params: Mapping[str, Any], score: float | None) -> None:
        self.tell_objectives(params, None if score is None else (score,))

    def tell_objectives(self, params: Mapping[str, Any], values: Sequence[float] | None) -> None:
        from optuna.trial import TrialState, create_trial

        asked = next((trial for trial in self._open if trial.params == params), None)
        if asked is not None:
            self._open.remove(asked)
            self._study.tell(asked, values, state=TrialState.FAIL if values is None else None)
        elif values is not None:
            done = create_trial(params=dict(params), distributions=self._distributions, values=list(values))
            self._study.add_trial(done)


def distribution(key: str, op: Operator) -> Any:
    """Optuna's distribution for a parameter; values of a list are represented by their labels.

    Raises:
        ConfigError: the operator is neither a list nor a range.
    """
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(op, NamedValues):
        return CategoricalDistribution([level.label for level in op.levels])
    if not isinstance(op, Range):
        raise ConfigError(f"parameters.{key}: optuna searches lists and ranges, not {type(op).__name__}")
    if op.whole:
        return IntDistribution(int(op.low), int(op.high), log=op.log)
    return FloatDistribution(op.low, op.high, log=op.log)
