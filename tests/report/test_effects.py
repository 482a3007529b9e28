"""Effects of parameters by hand."""

import numpy as np
import pytest

from msk_ray.report.effects import TrialScore, effects, levels_of, variance_share


def test_share_of_variance_by_hand() -> None:
    # Means 1 and 4, grand mean 2.5: between 4 · 2.25 = 9, within 4 · 1/4 = 1 over 2 degrees of freedom, MS = 0.5.
    # ω² = (9 − 0.5) / (10 + 0.5).
    assert variance_share([[0.5, 1.5], [3.5, 4.5]]) == pytest.approx(8.5 / 10.5)
    assert variance_share([[0.0, 1.0], [0.0, 1.0]]) == pytest.approx(-0.5 / 1.5), "none, less chance"
    assert variance_share([[1.0], [2.0]]) is None
    assert variance_share([[1.0, 1.0], [1.0]]) == 0.0


def test_levels_of_numbers_and_names() -> None:
    rows = [("big", 10, 1.0), ("small", 2, 2.0), ("big", 10, 3.0)]
    assert levels_of(rows) == {"small": [2.0], "big": [1.0, 3.0]}
    assert list(levels_of([("b", "b", 1.0), ("a", "a", 2.0)])) == ["b", "a"], "names stay in order"
    drawn = [(f"{n}", float(n), float(n)) for n in range(12)]
    quarters = levels_of(drawn)
    assert [len(scores) for scores in quarters.values()] == [3, 3, 3, 3]
    assert next(iter(quarters.values())) == [0.0, 1.0, 2.0]
    close = levels_of([("", 1000 + n, float(n)) for n in range(12)])
    assert list(close) == ["1000 … 1003", "1003 … 1006", "1006 … 1008", "1008 … 1011"], "digits that tell them apart"
    assert [len(items) for items in close.values()] == [3, 3, 3, 3]


def test_the_parameter_that_matters_comes_first() -> None:
    rng = np.random.default_rng(0)
    trials = []
    for seed in range(4):
        for rate in (0.1, 0.01):
            for horizon in (8, 16):
                score = (100.0 if rate == 0.1 else 0.0) + rng.normal()
                trials.append(TrialScore({"lr": f"{rate}", "h": f"{horizon}"}, {"lr": rate, "h": horizon}, seed, score))
    ranked = effects(trials)
    assert ranked[0].factor == "lr"
    assert {effect.factor for effect in ranked} == {"lr", "h", "seed"}
    assert ranked[0].share == pytest.approx(1.0, abs=0.01)
    assert ranked[0].spread == pytest.approx(100.0, abs=2.0)
    assert max(effect.share or 0.0 for effect in ranked[1:]) < 0.1
    assert effects([TrialScore({"lr": "1"}, {"lr": 1}, 0, 5.0)]) == []


def scored(level: float, *scores: float | None) -> list[TrialScore]:
    return [TrialScore({"lr": f"{level}"}, {"lr": level}, 0, score) for score in scores]


def test_too_few_scores_give_no_share_and_say_where() -> None:
    enough = [*scored(0.1, 0.5, 1.5), *scored(0.2, 3.5, 4.5)]
    (effect,) = effects(enough)
    assert (effect.share, effect.too_few) == (pytest.approx(8.5 / 10.5), "")
    # One more level nobody was trained at, or once: what lies between the others is not the parameter's effect.
    (effect,) = effects([*enough, *scored(0.3, None, None)])
    assert (effect.share, effect.too_few, effect.spread) == (None, "0.3 has none", 3.0)
    (effect,) = effects([*scored(0.1, 1.0, 2.0), *scored(0.2, 3.0, None)])
    assert (effect.share, effect.too_few, effect.spread) == (None, "0.2 has 1", 1.5)
    (effect,) = effects([*scored(0.1, 1.0, 2.0), *scored(0.2, None), *scored(0.3, None)])
    assert (effect.share, effect.too_few, effect.spread) == (None, "0.2 has none, and 1 more", None)
