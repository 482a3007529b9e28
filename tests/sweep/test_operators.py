"""Operators of a search space, by hand-worked numbers."""

import math
import random

import pytest

from msk_ray.errors import ConfigError
from msk_ray.sweep.operators import Level, parse_operator
from msk_ray.sweep.operators.lists import Grid
from msk_ray.sweep.operators.ranges import LogUniform, RandInt, Uniform
from msk_ray.text import describe


def test_grid_keeps_order_and_takes_labels() -> None:
    op = parse_operator("shac.horizon", {"grid": [16, {"label": "grow", "value": {"start": 8, "end": 32}}]})
    assert op == Grid((Level(16, "16"), Level({"start": 8, "end": 32}, "grow")))


def test_text_numbers_of_yaml_are_numbers() -> None:
    assert parse_operator("a", {"loguniform": ["1e-5", "1e-2"]}) == LogUniform(1e-5, 1e-2)


def test_draws_stay_inside_and_cover_the_range() -> None:
    rng = random.Random(0)
    draws = [LogUniform(1e-4, 1e-2).draw(rng).value for _ in range(2000)]
    assert 1e-4 <= min(draws) < 1.05e-4
    assert 0.95e-2 < max(draws) <= 1e-2
    # Half of a log-uniform draw lies below the geometric mean.
    assert sum(value < 1e-3 for value in draws) == pytest.approx(1000, abs=100)


def test_randint_includes_both_ends() -> None:
    rng = random.Random(0)
    assert {RandInt(2, 4).draw(rng).value for _ in range(100)} == {2, 3, 4}


def test_whole_numbers_of_any_length_are_told_apart() -> None:
    op, rng = RandInt(1_000_000, 1_000_009), random.Random(0)
    assert {level.label for level in (op.draw(rng) for _ in range(100))} == {str(1_000_000 + n) for n in range(10)}


def test_draws_have_six_digits() -> None:
    value = Uniform(0.0, 1.0).draw(random.Random(1)).value
    assert value == float(f"{value:.6g}")
    assert math.isclose(value, random.Random(1).uniform(0, 1), rel_tol=1e-5)


def test_clip() -> None:
    assert Uniform(0.0, 1.0).clip(1.12) == 1.0
    assert RandInt(2, 9).clip(4.6) == 5


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"gird": [1]}, "did you mean 'grid'"),
        ([1, 2], "write one of"),
        ({"grid": []}, "must be a list"),
        ({"uniform": [1]}, "two numbers"),
        ({"uniform": [1, "x"]}, "two numbers"),
        ({"uniform": [2, 1]}, "low 2 must be below high 1"),
        ({"loguniform": [0, 1]}, "above 0"),
        ({"randint": [0.5, 2]}, "whole numbers"),
    ],
)
def test_faults_name_the_parameter(data: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        parse_operator("shac.gamma", data)
    assert "shac.gamma" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_describe() -> None:
    assert describe({"start": 8, "x": [0.33, True]}) == "start=8 x=[0.33, true]"
    assert describe(None) == "null"
    assert describe(1e-5) == "1e-05"
