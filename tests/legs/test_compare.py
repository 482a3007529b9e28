"""Gaits beside people's, with differences worked out by hand."""

import math

import numpy as np
import pytest

from msk_ray.legs.gait.compare import FARTHEST, JUDGED, at_speed, difference, gait_distance, timing
from msk_ray.legs.gait.people import EMG, curve, envelope, pace, pace_polynomials


def test_the_mean_of_people_is_at_distance_zero() -> None:
    same = {name: difference(name, curve(name).mean) for name in JUDGED}
    people = pace(1.3)
    total, parts = gait_distance(same, at_speed(1.3, people.cadence, people.step_length), 0.62, 0.0)
    assert total == pytest.approx(0.0, abs=1e-9)
    assert set(parts) == {*JUDGED, "cadence", "step_length", "duty_factor", "asymmetry"}
    for found in same.values():
        assert found.within == found.within_centred == 1.0
        assert found.correlation == pytest.approx(1.0)


def test_differences_by_hand() -> None:
    knee = curve("knee_flexion")
    shifted = difference("knee_flexion", knee.mean + 3.0)
    assert (shifted.rmse, shifted.rmse_centred) == pytest.approx((3.0, 0.0), abs=1e-9)
    assert shifted.deviations == pytest.approx(math.sqrt(np.mean((3.0 / knee.sd) ** 2)))
    assert difference("knee_flexion", knee.mean + 2.01 * knee.sd).within == 0.0
    assert difference("knee_flexion", knee.mean + 1.99 * knee.sd).within == 1.0
    opposite = difference("knee_flexion", 100.0 - knee.mean)
    assert opposite.correlation == pytest.approx(-1.0)
    assert difference("knee_flexion", np.full(101, 20.0)).correlation is None


def test_the_first_per_cent_of_the_force_and_the_spread_in_swing_are_left_out() -> None:
    force = curve("vertical_force")
    wrong = force.mean.copy()
    wrong[:6] = 9.0
    assert difference("vertical_force", wrong).rmse == pytest.approx(0.0)
    assert force.sd[90] == 0.0
    wrong[90] = 0.03
    # one of 95 samples is one (least) standard deviation away
    assert difference("vertical_force", wrong).deviations == pytest.approx(math.sqrt(1.0 / 95.0))


def test_people_at_a_speed() -> None:
    cadence, step = pace_polynomials()
    speed = np.array([0.4932, 0.8623, 1.2318, 1.4173])
    np.testing.assert_allclose(np.polyval(cadence, speed), [72.70, 97.58, 115.83, 123.14], atol=0.6)
    np.testing.assert_allclose(np.polyval(step, speed), [0.407, 0.530, 0.638, 0.690], atol=3e-3)
    people = pace(1.25)
    assert people.cadence * people.step_length / 60.0 == pytest.approx(1.25, rel=0.02), "the three belong together"
    beside = at_speed(1.25, people.cadence + 3 * people.cadence_sd, people.step_length)
    assert beside["cadence"]["deviations"] == pytest.approx(3.0)
    assert not beside["cadence"]["within"]
    assert beside["step_length"]["within"]
    assert at_speed(None, None, None) == at_speed(-0.1, 90.0, 0.1) == {}


def test_the_distance_by_hand() -> None:
    knee = curve("knee_flexion")
    one = difference("knee_flexion", knee.mean + knee.sd)
    people = pace(1.25)
    beside = at_speed(1.25, people.cadence - 2 * people.cadence_sd, people.step_length + 50 * people.step_length_sd)
    total, parts = gait_distance({"knee_flexion": one}, beside, 0.68, 15.0)
    # Three curves are missing, the steps are too long by far.
    expected = {"knee_flexion": 1.0, "cadence": 2.0, "step_length": FARTHEST, "duty_factor": 3.0, "asymmetry": 3.0}
    assert {name: parts[name] for name in expected} == pytest.approx(expected)
    assert parts["hip_flexion"] == FARTHEST
    assert total == pytest.approx(math.sqrt((1 + 4 + 100 + 9 + 9 + 300) / 8))
    assert gait_distance({}, {}, None, None)[0] == FARTHEST


def test_timing_is_a_correlation_with_the_electromyogram() -> None:
    for muscle in EMG:
        measured = envelope(muscle).mean
        assert timing(muscle, 0.1 + 2.0 * measured) == pytest.approx(1.0)
        assert timing(muscle, -measured) == pytest.approx(-1.0)
        assert timing(muscle, np.ones(101)) is None
    assert 30 < np.argmax(envelope("gastroc").mean) < 50, "the calf pushes off"
    assert np.argmax(envelope("tibant").mean) in (0, 2, 100), "the shin lowers the foot after its strike"
