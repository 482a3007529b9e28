"""One rule per environment of a sweep, because scores of different environments are not comparable."""

from collections.abc import Iterable, Mapping

from msk_ray.errors import ConfigError
from msk_ray.experiment.outcomes import Ending
from msk_ray.sweep.rules.early_stopping import Pruner


class PerEnvironment:
    """Passes each trial's evaluations to its environment's rule; ignores unknown trials."""

    def __init__(self, rules: Mapping[str, Pruner], environments: Mapping[str, str]) -> None:
        """
        Args:
            rules: environment → its rule.
            environments: trial → its environment.
        """
        self._rules = {trial: rules[environment] for trial, environment in environments.items()}

    def report(self, trial: str, time: float, score: float) -> Ending | None:
        rule = self._rules.get(trial)
        return None if rule is None else rule.report(trial, time, score)

    def forget(self, trial: str) -> None:
        if trial in self._rules:
            self._rules[trial].forget(trial)


def refuse_several(environments: Iterable[str], who: str) -> None:
    """Raise if a setting would compare trials of different environments.

    Args:
        environments: names of the trials' environments.
        who: the setting that compares them, and what it does.

    Raises:
        ConfigError: there is more than one environment.
    """
    names = list(dict.fromkeys(environments))
    if len(names) > 1:
        raise ConfigError(
            f"{who}, and scores of different environments ({', '.join(names)}) cannot be compared; write a space for "
            "each"
        )
