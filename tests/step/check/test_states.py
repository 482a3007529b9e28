import mujoco
import numpy as np
import pytest
from small_models import ant_xml

from msk_ray.errors import ConfigError
from msk_ray.step.check import STATE_KINDS, Oracle, make_states
from msk_ray.step.check.oracle import INPUTS


@pytest.fixture(scope="module")
def ant() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ant_xml("elliptic"))


@pytest.mark.parametrize("kind", STATE_KINDS)
def test_states(ant, kind):
    states = make_states(ant, kind, 5, seed=1)
    again, other = make_states(ant, kind, 5, seed=1), make_states(ant, kind, 5, seed=2)
    assert len(states) == 5
    for name in INPUTS:
        values = np.stack([getattr(p, name) for p in states])
        assert values.dtype == np.float64
        np.testing.assert_array_equal(values, values.astype(np.float32))
        np.testing.assert_array_equal(values, np.stack([getattr(p, name) for p in again]))
        if values.size:
            assert not np.array_equal(values, np.stack([getattr(p, name) for p in other]))
            assert len(np.unique(values, axis=0)) == 5, "worlds must differ"
    for p in states:
        assert np.linalg.norm(p.qpos[3:7]) == pytest.approx(1.0, abs=1e-6)
        assert np.all(np.abs(p.ctrl) < 1.0), "a control on its bound is a kink"


def test_contact_states_touch_and_move(ant):
    oracle = Oracle(ant, 1)
    states = make_states(ant, "contact", 8, seed=0)
    assert all(oracle.touching(p) for p in states)
    assert np.median([np.linalg.norm(p.qvel) for p in states]) > 0.5


def test_standing_states_touch_and_rest(ant):
    oracle = Oracle(ant, 1)
    states = make_states(ant, "standing", 4, seed=0)
    assert all(oracle.touching(p) for p in states)
    assert max(np.linalg.norm(p.qvel) for p in states) < 1.0


def test_model_without_contacts_still_has_contact_states(cartpole):
    assert len(make_states(cartpole, "contact", 3, seed=0)) == 3


def test_unknown_kind(cartpole):
    with pytest.raises(ConfigError, match="standing, random, contact, policy"):
        make_states(cartpole, "flying", 1, seed=0)


def test_muscle_states_are_off_the_clamps():
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody><body><joint name="j"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03"/></body>
        </worldbody><actuator><muscle joint="j" lengthrange="0.1 1"/></actuator></mujoco>""")
    for kind in STATE_KINDS:
        for p in make_states(model, kind, 3, seed=0):
            assert 0.0 < p.ctrl[0] < 1.0
            assert 0.0 <= p.act[0] <= 1.0
