"""Several objectives of a search."""

import math

import pytest

from msk_ray.experiment.metrics import last_figures
from msk_ray.sweep.operators import parse_operator

NAMES = ("eval/gait_distance", "eval/fall_rate")


def test_the_figures_are_those_of_the_last_evaluation_of_a_trained_policy() -> None:
    def row(epoch: int, **figures: float) -> dict[str, float]:
        evaluated = {f"eval/{name}": value for name, value in figures.items()}
        return {"epoch": epoch, "env_steps": 10 * epoch, "seconds": 1.0 * epoch, **evaluated}

    untrained, first, second = row(0, score=1.0, gait_distance=9.0, fall_rate=1.0), row(2, score=2.0), row(3)
    third = row(4, score=1.5, gait_distance=3.0, fall_rate=0.25)
    assert last_figures([untrained, first, second, third, row(5)], NAMES) == (3.0, 0.25)
    assert last_figures([untrained, second], NAMES) is None
    assert last_figures([third, row(6, score=1.0)], NAMES) is None, "the last evaluation lacks them"
    assert last_figures([row(6, score=1.0, gait_distance=math.nan, fall_rate=0.0)], NAMES) is None
    assert last_figures([], NAMES) is None


def test_optuna_keeps_what_no_other_trial_beats_in_everything() -> None:
    pytest.importorskip("optuna")
    from msk_ray.sweep.search.tpe import OptunaSearch

    weight = {"env.reward.effort": parse_operator("env.reward.effort", {"uniform": [0.0, 1.0]})}
    search = OptunaSearch(weight, 0, dict.fromkeys(NAMES, "minimize"))
    for effort, values in ((0.1, (3.0, 0.1)), (0.2, (1.0, 0.5)), (0.3, (4.0, 0.6)), (0.4, None)):
        search.tell_objectives({"env.reward.effort": effort}, values)
    asked = search.ask()
    search.tell_objectives(asked, None)
    best = {trial.params["env.reward.effort"] for trial in search._study.best_trials}
    assert best == {0.1, 0.2}
    assert asked["env.reward.effort"] == pytest.approx(0.5, abs=0.5)
