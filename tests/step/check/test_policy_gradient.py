"""The policy gradient through eight env steps of four substeps, against float64 differences of the whole loss."""

import numpy as np
from policy_gradient import check_chain

from msk_ray.config import PhysicsConfig
from msk_ray.envs.ant.config import AntSettings
from msk_ray.envs.ant.model import build_ant
from msk_ray.envs.cartpole.config import CartPoleSettings
from msk_ray.envs.cartpole.model import build_cartpole
from msk_ray.step import TapePerSubstep
from msk_ray.step.check import Point, make_states


def test_cartpole():
    model = build_cartpole(CartPoleSettings(name="cartpole"), PhysicsConfig())
    points = make_states(model, "random", 2, 0)
    for result in check_chain(model, TapePerSubstep(), points, (1, 8), substeps=4):
        assert result.rel_error <= 1e-3


def test_ant_before_its_first_impact():
    model = build_ant(AntSettings(name="ant"), PhysicsConfig())
    rng = np.random.default_rng(0)
    qpos = model.key_qpos[0].copy()
    qpos[2] = 1.2  # eight env steps of falling end above the ground
    point = Point(np.zeros(8), qpos, 0.3 * rng.normal(size=14), np.zeros(0))
    (result,) = check_chain(model, TapePerSubstep(), [point], (8,), substeps=4)
    assert result.rel_error <= 1e-3


def test_ant_standing_on_its_feet():
    model = build_ant(AntSettings(name="ant"), PhysicsConfig(variant="matched_hard_friction"))
    (point,) = make_states(model, "standing", 1, 0)
    (result,) = check_chain(model, TapePerSubstep(), [point], (8,), substeps=4)
    assert result.rel_error <= 1e-3
