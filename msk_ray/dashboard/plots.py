"""Optuna's own plots of an experiment: history, importances, contour, slices."""

import json
from collections.abc import Mapping
from functools import cache
from typing import Any

from msk_ray.config import current_key
from msk_ray.errors import ConfigError
from msk_ray.experiment.trial import Trial
from msk_ray.report.reading import Reading
from msk_ray.sweep.operators import NamedValues, Operator, Range, parse_operator
from msk_ray.sweep.search.tpe import distribution

MISSING = "Optuna's plots need optuna and plotly: pip install 'msk-ray[dashboard]'"
_LEAST = 3
"""Trials with a score that the plots need."""


def can_plot(reading: Reading) -> bool:
    """Whether an experiment has parameters for these plots."""
    return reading.space is not None and bool(reading.space.parameters) and len(reading.environments) == 1


@cache
def plotly_library() -> str:
    """Plotly's script.

    Raises:
        ConfigError: plotly is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise ConfigError(MISSING) from None
    script: str = get_plotlyjs()
    return script


def figures(reading: Reading) -> list[tuple[str, str]]:
    """(title, figure as Plotly's JSON) of each plot; instead of a figure, text in parentheses says what is missing.

    Raises:
        ConfigError: a package is missing, the space has other operators, or there are too few trials.
    """
    study, names = _study(reading)
    from optuna import visualization
    from optuna.importance import get_param_importances

    makers: dict[str, Any] = {
        "History": lambda: visualization.plot_optimization_history(study, target_name="best score"),
        "Importances": lambda: visualization.plot_param_importances(study, target_name="best score"),
    }
    if len(names) > 1:

        def contour() -> Any:
            first = list(get_param_importances(study))[:2]
            return visualization.plot_contour(study, params=first, target_name="best score")

        makers["Contour of the two most important"] = contour
    makers["Slices"] = lambda: visualization.plot_slice(study, target_name="best score")
    plots = []
    for title, make in makers.items():
        try:
            figure = make()
        except (ValueError, RuntimeError) as error:  # such as importances where all scores are equal
            plots.append((title, f"({' '.join(str(error).split())})"))
        else:
            # Without the template, which is as large as the rest, and without a fixed size.
            figure.update_layout(template="none", width=None, height=None, autosize=True, title=None)
            plots.append((title, json.dumps(json.loads(figure.to_json())).replace("<", "\\u003c")))
    return plots


def _study(reading: Reading) -> tuple[Any, list[str]]:
    """A study with the experiment's trials that have a score, and its parameters."""
    try:
        import optuna
        import plotly  # noqa: F401
    except ImportError:
        raise ConfigError(MISSING) from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    assert reading.space is not None  # see `can_plot`
    written = reading.space.parameters
    parameters = {current_key(key): parse_operator(key, value) for key, value in written.items()}
    distributions = {key: distribution(key, op) for key, op in parameters.items()}
    study = optuna.create_study(direction="maximize")
    for trial in reading.trials:
        params = _params(trial.trial, parameters)
        if trial.score is not None and params is not None:
            # Added one by one, a study of thousands would be sorted thousands of times.
            study.add_trial(optuna.trial.create_trial(params=params, distributions=distributions, value=trial.score))
    if len(study.trials) < _LEAST:
        raise ConfigError(f"Optuna's plots need {_LEAST} trials with a score; there are {len(study.trials)}")
    return study, list(distributions)


def _params(trial: Trial, parameters: Mapping[str, Operator]) -> dict[str, Any] | None:
    """A trial's values in Optuna's form; None if the space does not allow one of them."""
    params: dict[str, Any] = {}
    for key, op in parameters.items():
        if isinstance(op, NamedValues):
            label = trial.changed.get(key)
            if label not in [level.label for level in op.levels]:
                return None
            params[key] = label
        elif isinstance(op, Range):
            value = trial.values.get(key)
            if not isinstance(value, int | float) or not op.low <= value <= op.high:
                return None
            params[key] = value
    return params
