"""Diagnostics of a trial whose worlds are spread over several processes."""

import math

import pytest

from msk_ray.algorithms.base import _of_all


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("physics/contacts_share", 0.75),
        ("physics/solver_residual_max", 0.75),
        ("physics/fd_solver_limit_share", 0.75),
        ("randomize/gravity_min", 0.25),
        ("randomize/gravity_max", 0.75),
        ("physics/solver_limit_share", 0.5),
        ("grad/approximated_share", 0.5),
    ],
)
def test_shares_of_worlds_are_averaged_and_extremes_stay_extremes(name: str, expected: float) -> None:
    assert _of_all(name, [0.25, 0.75]) == expected
    assert math.isnan(_of_all(name, [0.25, math.nan]))
