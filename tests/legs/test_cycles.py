"""Gait cycles of synthetic gaits whose measures are worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from msk_ray.legs.gait import cycles
from msk_ray.legs.gait.body import CURVES, Episode
from msk_ray.legs.gait.measure import measure
from msk_ray.legs.gait.ranges import LANDMARKS, MEASURES
from msk_ray.legs.gait.stick import one_stride

STEP = 0.02
"""Seconds between samples."""


def test_contact_needs_load_and_ignores_chatter() -> None:
    #              0  1  2   3   4  5   6   7   8  9 10 11 12
    force = np.array([0, 0, 60, 70, 0, 80, 90, 70, 0, 0, 0, 60, 0.0])
    contact = cycles.on_ground(force, 1000.0, least=2)
    # the gap of one at 4 is closed, then the contact of one at 11 is undone; 40 N would not have counted
    assert contact.tolist() == [False, False, True, True, True, True, True, True, False, False, False, False, False]
    assert not cycles.on_ground(np.full(5, 40.0), 1000.0, least=1).any()
    assert cycles.on_ground(np.full(5, 60.0), 1000.0, least=1).all()


def test_strides_by_hand() -> None:
    contact = np.array([1, 1, 0, 0, 1, 1, 1, 0, 1, 1, 0, 0, 0, 1], dtype=bool)
    assert cycles.strikes(contact).tolist() == [4, 8, 13], "an episode that starts on the ground has not struck it"
    first, second = cycles.strides(contact)
    assert first == (4, 7, 8)
    assert second == (8, 10, 13)
    assert (first.duty, second.duty) == (0.75, 0.4)


def test_a_curve_is_sampled_at_each_percent() -> None:
    curve = cycles.over_cycle(np.arange(20.0) ** 1, cycles.Stride(5, 8, 10))
    assert curve.shape == (101,)
    assert curve[[0, 20, 50, 100]].tolist() == pytest.approx([5.0, 6.0, 7.5, 10.0])


def test_steps_and_cadence_by_hand() -> None:
    right = np.array([0, 1, 1, 0, 0, 0, 0, 0, 0, 1], dtype=bool)
    left = np.array([0, 0, 0, 0, 0, 1, 1, 0, 0, 0], dtype=bool)
    place = np.array([0.0, 0.7, 0.7, 0.7, 1.0, 1.2, 1.5, 1.9, 2.0, 2.1])
    other = np.array([0.0, 0.1, 0.3, 0.8, 1.2, 1.4, 1.4, 1.4, 1.4, 1.4])
    assert cycles.step_lengths(right, place, other).tolist() == pytest.approx([0.6, 0.7])
    # strikes at samples 1, 5 and 9: two steps in 8 samples of 0.1 s
    assert cycles.cadence(right, left, 0.1) == pytest.approx(150.0)
    assert cycles.cadence(right, np.zeros(10, dtype=bool), 1.0) == pytest.approx(7.5)
    assert cycles.cadence(np.zeros(10, dtype=bool), np.zeros(10, dtype=bool), 1.0) is None
    hop = np.array([0, 0, 1, 1], dtype=bool)
    assert cycles.cadence(hop, hop, 0.1) is None, "both feet come down at once, once"


def test_symmetry_by_hand() -> None:
    assert cycles.symmetry_index(0.6, 0.6) == 0.0
    assert cycles.symmetry_index(0.66, 0.54) == pytest.approx(20.0)
    assert cycles.symmetry_index(0.0, 0.0) is None


def test_extrema_are_looked_for_within_their_phase() -> None:
    curve = np.concatenate((np.linspace(0, 50, 51), np.linspace(49, 0, 50)))
    assert cycles.extremum(curve, (60, 90), "max") == 40.0
    assert cycles.extremum(curve, (10, 40), "min") == 10.0
    assert cycles.extremum(curve, (25, 90), "at") == 25.0


def walking(limp: float = 0.0, seconds: float = 6.0) -> Episode:
    """Steps of 0.5 s at 1.2 m/s: each foot stands for 0.6 s of its stride of 1 s and swings for 0.4.

    `limp` takes this much off the left foot's stance [s].
    """
    time = np.arange(round(seconds / STEP)) * STEP
    curves: dict[str, dict[str, np.ndarray]] = {name: {} for name in CURVES}
    feet = {}
    forward = 1.2 * time
    for side, shift, stance in (("r", 0.0, 0.6), ("l", 0.5, 0.6 - limp)):
        phase = (time + shift + 1e-9) % 1.0
        on_ground = phase < stance - 1e-9
        curves["vertical_force"][side] = np.where(on_ground, 0.8, 0.0)
        # On landing the heel is 0.36 m ahead of the pelvis; in swing it does not matter where it is.
        feet[side] = np.where(on_ground, forward - 1.2 * phase + 0.36, forward)
        curves["hip_flexion"][side] = 10.0 + 20.0 * np.cos(2 * np.pi * phase)
        for name in ("knee_flexion", "ankle_dorsiflexion", "forward_force"):
            curves[name][side] = np.zeros(len(time))
    activation = np.full((len(time), 4), 0.5)
    muscles = {"tibant": {side: np.cos(2 * np.pi * time) for side in "rl"}}
    power = np.full(len(time), 84.0)
    return Episode(STEP, 700.0, forward, feet, curves, activation, power, 2.0 * power, muscles)


def test_a_synthetic_walk_measures_what_it_was_made_of() -> None:
    found = measure([walking()], [False])
    values = {name: entry["value"] for name, entry in found["measures"].items()}
    assert values["speed"] == pytest.approx(1.2)
    assert values["cadence"] == pytest.approx(120.0)
    # The other foot landed half a stride before, 0.6 m behind.
    assert values["step_length"] == pytest.approx(0.6)
    assert values["duty_factor"] == pytest.approx(0.6)
    assert values["symmetry_step_length"] == pytest.approx(0.0, abs=1e-6)
    assert values["symmetry_duty_factor"] == pytest.approx(0.0, abs=1e-6)
    assert found["measures"]["speed"]["within"]
    assert not found["measures"]["step_length"]["within"]
    # After the first second the right foot strikes at 2, 3, 4, 5 s and the left at 1.5 to 5.5 s.
    assert found["strides"] == 3 + 4
    hip = np.array(found["curves"]["hip_flexion"]["r"]["mean"])
    assert hip[[0, 25, 50, 75, 100]] == pytest.approx([30.0, 10.0, -10.0, 10.0, 30.0], abs=1e-3)
    assert found["landmarks"]["hip_at_strike"]["value"] == pytest.approx(30.0, abs=1e-3)
    assert found["landmarks"]["hip_most_extended"]["within"]
    assert found["curve_asymmetry"]["hip_flexion"] == pytest.approx(0.0, abs=1e-6)
    assert found["costs"]["mean_squared_activation"] == pytest.approx(0.25)
    # 4 muscles × 0.25 / 1.2 m/s, and 84 W over 700 N × 1.2 m/s
    assert found["costs"]["activation_per_metre"] == pytest.approx(1.0 / 1.2, rel=0.01)
    assert found["costs"]["work_per_metre"] == pytest.approx(0.1, rel=0.01)
    # 168 W for muscles and 1.2 W/kg at rest, over 700 N × 1.2 m/s
    assert found["costs"]["cost_of_transport"] == pytest.approx((168.0 + 1.2 * 700 / 9.81) / 840.0, rel=0.01)
    assert found["falls"] == 0.0


def test_a_limp_shows_in_the_symmetry() -> None:
    found = measure([walking(limp=0.12)], [False])
    assert found["by_side"]["duty_factor"]["r"] == pytest.approx(0.6)
    assert found["by_side"]["duty_factor"]["l"] == pytest.approx(0.48)
    assert found["measures"]["symmetry_duty_factor"]["value"] == pytest.approx(100 * 0.12 / 0.54)
    assert not found["measures"]["symmetry_duty_factor"]["within"]


def test_what_no_episode_showed_is_null() -> None:
    found = measure([walking(seconds=0.9), walking(seconds=1.1)], [True, False])
    assert found["falls"] == 0.5
    assert found["strides"] == 0
    assert found["measures"]["cadence"] == {
        "value": None,
        "human": [91.0, 135.0],
        "within": None,
        "unit": "steps/min",
        "source": MEASURES["cadence"].source,
    }
    assert found["curves"]["knee_flexion"] == {"r": None, "l": None}


@pytest.mark.parametrize(("speed", "step_length"), [(1.54, 0.79), (1.31, 0.66)])
def test_measured_means_lie_in_the_human_ranges(speed: float, step_length: float) -> None:
    """Means of men (Murray, Drought & Kory 1964) and women (Murray, Kory & Sepic 1970), both at 117 steps a minute."""
    assert speed == pytest.approx(step_length * 117.0 / 60.0, rel=0.02), "the three belong together"
    for name, value in (("speed", speed), ("cadence", 117.0), ("step_length", step_length)):
        assert MEASURES[name].least < value < MEASURES[name].most


def test_every_human_range_has_a_source_and_a_curve() -> None:
    for limits in (*MEASURES.values(), *(landmark.range for landmark in LANDMARKS.values())):
        assert limits.least < limits.most
        assert len(limits.source) > 20
    assert {landmark.curve for landmark in LANDMARKS.values()} <= set(CURVES)


@pytest.mark.parametrize("timestep", [0.02, 0.004])
def test_a_foot_that_bounces_has_not_taken_a_step(timestep: float) -> None:
    time = np.arange(round(6.0 / timestep)) * timestep + 1e-9
    force = np.where((time % 1.0 < 0.6) & ~((time % 1.0 > 0.3) & (time % 1.0 < 0.34)), 0.8, 0.0)
    episode = replace(walking(), timestep=timestep, forward=time, curves={"vertical_force": {"r": force}})
    stride, seconds = one_stride([episode], [time[:, None]])
    assert seconds == pytest.approx(1.0)
    assert len(stride) == round(1.0 / timestep)
    assert stride[0, 0] % 1.0 == pytest.approx(0.0, abs=1e-6)
