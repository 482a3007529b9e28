"""Stopping and pruning rules, by hand-worked histories."""

import math

import pytest

from msk_ray.errors import ConfigError
from msk_ray.experiment.evaluation_log import LogEntry
from msk_ray.experiment.metrics import Evaluation, evaluations_of
from msk_ray.experiment.outcomes import Outcome
from msk_ray.sweep.rules.asha import Asha, SuccessiveHalving
from msk_ray.sweep.rules.median import Median, MedianStopping
from msk_ray.sweep.rules.plateau import Plateau
from msk_ray.sweep.rules.scheduler import replay
from msk_ray.sweep.rules.stop_rule import History
from msk_ray.sweep.rules.stopping import StopSpec
from msk_ray.sweep.space import read_file


def evaluations(*scores: float) -> list[Evaluation]:
    return [Evaluation(10 * i, 1000 * i, float(i), score) for i, score in enumerate(scores)]


def row(epoch: int = 10, **metrics: float) -> dict[str, float]:
    return {"epoch": epoch, "env_steps": 100.0 * epoch, "seconds": float(epoch), **metrics}


def after(seen: list[Evaluation], epochs: int) -> History:
    """Of a trial whose newest epoch was evaluated."""
    return History(row(seen[-1].epoch, **{"eval/score": seen[-1].score}), seen, epochs, 1.0)


def test_rungs() -> None:
    rule = Asha(kind="asha", grace=0.125, reduction=3)
    assert rule.rungs(80) == (10, 30)
    assert Asha(kind="asha", grace=0.1, reduction=3).rungs(100) == (10, 30, 90)


def test_halving_in_lockstep_stops_the_worse_at_its_next_report() -> None:
    rule = SuccessiveHalving((100,), 2)
    assert rule.report("bad", 100, 1.0) is None  # nobody to compare with yet
    assert rule.report("good", 100, 2.0) is None
    ending = rule.report("bad", 140, 1.5)
    assert ending is not None
    assert ending.outcome is Outcome.STOPPED_ASHA
    assert "number 2 of 2 at rung 100" in ending.why
    assert rule.report("good", 140, 0.0) is None  # judged by what it had at the rung
    assert rule.report("bad", 142, 1.5) is None  # past 100 · √2 the rung at 100 says nothing any more


def test_halving_compares_best_scores_so_far() -> None:
    rule = SuccessiveHalving((100,), 2)
    rule.report("a", 50, 5.0)
    rule.report("a", 100, 1.0)
    assert rule.report("b", 100, 4.0) is not None  # a counts with 5


def test_halving_waits_for_enough_trials() -> None:
    rule = SuccessiveHalving((100,), 3)
    assert rule.report("a", 100, 3.0) is None
    assert rule.report("b", 100, 2.0) is None
    ending = rule.report("c", 100, 1.0)
    assert ending is not None  # three are there, one continues
    assert rule.report("b", 110, 9.0) is not None
    assert rule.report("a", 110, 0.0) is None


def test_halving_judges_by_the_newest_rung_only() -> None:
    rule = SuccessiveHalving((100, 200), 2)
    rule.report("a", 100, 1.0)
    rule.report("a", 200, 10.0)
    rule.report("b", 100, 2.0)
    assert rule.report("a", 210, 10.0) is None
    assert rule.report("b", 200, 5.0) is not None


def test_halving_ignores_nan_and_repeated_rows() -> None:
    rule = SuccessiveHalving((100,), 2)
    assert rule.report("nan", 100, math.nan) is None
    rule.report("a", 100, 1.0)
    rule.report("a", 100, 5.0)
    assert rule.report("b", 100, 2.0) is None  # a counts with its first score there, 1.0


def test_halving_is_the_same_after_replay() -> None:
    history = [("a", 100.0, 1.0), ("b", 100.0, 3.0), ("c", 100.0, 2.0), ("b", 200.0, 4.0), ("c", 200.0, 5.0)]
    whole, resumed = SuccessiveHalving((100, 200), 2), SuccessiveHalving((100, 200), 2)
    for item in history:
        whole.report(*item)
    for item in history:
        resumed.report(*item)
    for probe in [("d", 100.0, 0.5), ("b", 210.0, 0.0), ("d", 200.0, 9.0)]:
        assert whole.report(*probe) == resumed.report(*probe)


def test_median_compares_best_with_the_median_of_means() -> None:
    rule = MedianStopping(grace=10, min_trials=3)
    for name, scores in {"a": (2.0, 4.0), "b": (4.0, 6.0), "c": (6.0, 8.0)}.items():
        for time, score in zip((10, 20), scores, strict=True):
            assert rule.report(name, time, score) is None
    # Means of the others up to 20: 3, 5, 7; the median is 5.
    assert rule.report("low", 20, 4.9) is not None
    assert rule.report("even", 20, 5.0) is None
    assert rule.report("fine", 20, 5.1) is None


def test_median_ignores_nan() -> None:
    rule = MedianStopping(grace=10, min_trials=1)
    assert rule.report("a", 10, 2.0) is None
    assert rule.report("b", 10, math.nan) is None
    assert rule.report("b", 20, 3.0) is None, "a has not come as far, and at 10 there is no score to judge"
    assert rule.report("c", 10, 1.0) is not None, "the median is a's alone"


def test_median_of_a_space_waits_for_three_others_and_its_grace() -> None:
    rule = Median(kind="median", grace=0.1).pruner(budget=1000)
    for time in (99, 100):
        for name in ("a", "b", "c"):
            assert rule.report(name, time, 2.0) is None
        # Before 100 nothing is compared.
        assert (rule.report("low", time, 1.0) is None) == (time == 99)
    two = Median(kind="median", grace=0.1).pruner(budget=1000)
    for name in ("a", "b"):
        two.report(name, 100, 2.0)
    assert two.report("low", 100, 1.0) is None
    two.report("c", 100, 2.0)
    assert two.report("low", 110, 1.0) is not None


def test_null_is_a_default_in_recorded_spaces_alone() -> None:
    data = {"question": "?", "base": "b", "scheduler": {"kind": "median", "min_trials": None}}
    assert read_file(data, "space", recorded=True) == read_file({**data, "scheduler": {"kind": "median"}}, "space")
    with pytest.raises(ConfigError, match="min_trials"):
        read_file(data, "space")


def test_median_in_lockstep_compares_where_the_others_have_been() -> None:
    rule = MedianStopping(grace=10, min_trials=2)
    assert rule.report("low", 10, 1.0) is None
    rule.report("a", 10, 2.0)
    rule.report("b", 10, 3.0)
    ending = rule.report("low", 20, 1.5)
    assert ending is not None
    assert "up to 10" in ending.why


class CountedScore(float):
    """A score that counts how often it is added to another."""

    additions = 0

    def __add__(self, other: float) -> float:
        CountedScore.additions += 1
        return float(self) + float(other)

    __radd__ = __add__


def test_median_does_not_add_up_the_scores_of_other_trials_at_each_report() -> None:
    costs = []
    for others in (4, 40):
        rule = MedianStopping(grace=10, min_trials=3)
        for number in range(others):
            for time in range(10, 30):
                rule.report(f"{number}", time, CountedScore(number))
        before = CountedScore.additions
        assert rule.report("low", 20, CountedScore(-1.0)) is not None
        costs.append(CountedScore.additions - before)
    assert costs[0] == costs[1]


def test_median_counts_the_newest_score_of_a_time() -> None:
    rule = MedianStopping(grace=10, min_trials=2)
    for name in ("a", "b"):
        rule.report(name, 20, 9.0)
        rule.report(name, 10, 2.0)
        rule.report(name, 10, 4.0)
    assert rule.report("low", 10, 3.9) is not None
    assert rule.report("fine", 10, 4.0) is None


def test_grace_is_a_share_of_the_budget() -> None:
    rule = Asha(kind="asha", grace=0.25, reduction=2.0, min_trials=2).pruner(budget=1000)
    rule.report("a", 249, 1.0)
    rule.report("b", 249, 2.0)
    assert rule.report("a", 249, 1.0) is None
    rule.report("b", 250, 2.0)
    assert rule.report("a", 250, 1.0) is not None


def test_plateau_needs_patience_and_grace() -> None:
    spec = Plateau(patience=2, min_delta=1.0, grace=0.5)
    assert spec.why(after(evaluations(5, 5, 5), 100)) is None  # epoch 20 of 100
    flat = spec.why(after(evaluations(1, 5, 8, 8.5, 9), 80))  # epoch 40 of 80; rise of 1.0 is not more than 1.0
    assert flat is not None
    assert "since epoch 20" in flat
    assert spec.why(after(evaluations(1, 5, 8, 8.5, 9.5), 80)) is None


def test_plateau_waits_for_evaluations_before_its_last_ones() -> None:
    spec = Plateau(patience=2, grace=0.0)
    assert spec.why(after(evaluations(5, 5), 10)) is None
    assert spec.why(after(evaluations(5, 5, 5), 10)) is not None, "no rise at all is none"
    between = History(row(25), evaluations(5, 5, 5), 10, 1.0)
    assert spec.why(between) is None, "an epoch without an evaluation has nothing to judge"


@pytest.mark.parametrize(
    ("metrics", "outcome"),
    [
        ({"eval/score": math.nan}, Outcome.NONFINITE),
        ({"train/critic_loss": math.inf}, Outcome.NONFINITE),
        ({"eval/score": 7.0}, Outcome.STOPPED_TARGET),
        ({"train/episode_return": math.nan}, None),
        ({}, None),
    ],
)
def test_ending_of_an_epoch(metrics: dict[str, float], outcome: Outcome | None) -> None:
    stop = StopSpec(target=6.0)
    seen = evaluations(1.0, metrics.get("eval/score", 2.0))
    ending = stop.ending(History(row(**metrics), seen, 100, 1.0))
    assert (ending and ending.outcome) == outcome


def test_last_epoch_and_wall_time() -> None:
    last = StopSpec().ending(History(row(100), evaluations(1.0), 100, 1.0))
    assert last is not None
    assert last.outcome is Outcome.FINISHED
    late = StopSpec(wall_time_s=5.0).ending(History(row(10), evaluations(1.0), 100, 5.0))
    assert late is not None
    assert late.outcome is Outcome.WALL_TIME


def test_the_untrained_policy_counts_in_no_rule() -> None:
    """It reaches the target and is never surpassed; the trial continues."""
    rows = [row(epoch, **{"eval/score": score}) for epoch, score in enumerate([100.0, 1.0, 2.0, 3.0])]
    seen = evaluations_of(rows)
    assert [evaluation.epoch for evaluation in seen] == [1, 2, 3]
    assert StopSpec(target=50.0).ending(History(row(1), evaluations_of(rows[:1]), 20, 1.0)) is None
    rule = StopSpec(target=50.0, plateau=Plateau(patience=2, grace=0.0))
    assert rule.ending(History(rows[3], seen, 20, 3.0)) is None


def test_a_stop_is_found_again_only_if_it_was_the_last_word() -> None:
    spec = Asha(kind="asha", grace=0.25, reduction=2)
    stopped = [LogEntry("a", 3, 300, 3.0, 2.0, False), LogEntry("b", 3, 300, 3.0, 1.0, False)]
    ending = replay(spec.pruner(1000), "env_steps", stopped)
    assert ending is not None
    assert "number 2 of 2" in ending.why
    finished = [*stopped[:1], LogEntry("b", 3, 300, 3.0, 1.0, True)]
    assert replay(spec.pruner(1000), "env_steps", finished) is None, "b ended by itself"
    assert replay(spec.pruner(1000), "env_steps", [*stopped, LogEntry("c", 1, 100, 1.0, 0.0, False)]) is None
    assert replay(spec.pruner(1000), "env_steps", []) is None
