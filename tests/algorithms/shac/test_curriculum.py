import copy
import math

import numpy as np
import pytest
import torch

from msk_ray.algorithms.shac import Shac
from msk_ray.algorithms.shac.curriculum import ContactSchedule, between
from msk_ray.config import ContactCurriculum, ContactStart, parse_config
from msk_ray.envs import make_env


def settings(**changes):
    return parse_config(
        {
            "env": {"name": "ant", "nworld": 4},
            "physics": {"variant": "matched_hard_friction", "substeps": 1},
            "shac": {"horizon": 2, "critic_batches": 1, "critic_iterations": 1},
            "actor": {"hidden": [8]},
            "critic": {"hidden": [8]},
            **changes,
        }
    )


def test_time_constants_go_by_ratio_and_signed_numbers_evenly() -> None:
    assert between([1.0, 1.0], [0.01, 1.0], 0.5) == pytest.approx([0.1, 1.0])
    assert between([-100.0], [-50.0], 0.5) == pytest.approx([-75.0])


def test_friction_hardens_step_by_step_and_ends_in_the_models_own() -> None:
    config = settings()
    env = make_env(config.env, config.physics, 4, "cpu", 0)
    curriculum = ContactCurriculum(start=ContactStart(solreffriction=(1.0, 1.0)), epochs=2)
    schedule = ContactSchedule(curriculum, env)

    def now(name: str) -> np.ndarray:
        return getattr(env.sim.batch.model, f"pair_{name}").numpy()[0]

    assert now("solreffriction")[0] == pytest.approx([1.0, 1.0])
    schedule.advance()
    # Half way to solref 0.065, for which the model's zero solreffriction stands.
    assert now("solreffriction")[0] == pytest.approx([math.sqrt(0.065), 1.0])
    schedule.advance()
    for name in ("solref", "solimp", "solreffriction", "friction"):
        assert now(name) == pytest.approx(np.asarray(getattr(env.model, f"pair_{name}")))


def test_the_world_slides_while_friction_is_soft() -> None:
    config = settings()
    env = make_env(config.env, config.physics, 4, "cpu", 0)

    def slide() -> float:
        state = env.sim.initial_state()
        qpos = state.qpos.clone()
        qpos[:, 2] = 0.45
        qvel = state.qvel.clone()
        qvel[:, 0] = 1.0
        for _ in range(20):
            qpos, qvel, _act = env.sim.step(torch.zeros(4, 8), qpos, qvel, state.act)
        return float(qvel[0, 0])

    hard = slide()
    ContactSchedule(ContactCurriculum(start=ContactStart(solreffriction=(5.0, 1.0)), epochs=2), env)
    assert slide() > hard + 0.2


def test_all_that_adapts_goes_on_from_a_checkpoint() -> None:
    config = settings(
        curriculum={"start": {"solreffriction": [1.0, 1.0]}, "epochs": 5},
        shac={
            "horizon": {"kind": "adaptive", "start": 3, "shortest": 2, "longest": 6, "target": 1e9},
            "critic_batches": 1,
            "critic_iterations": 1,
            "entropy": {"coefficient": 0.01, "target": 0.3},
        },
        critic={"hidden": [8], "count": 2},
    )
    env = make_env(config.env, config.physics, 4, "cpu", 0)
    shac = Shac(config, env)
    rows = [shac.update(epoch).metrics for epoch in range(2)]
    assert rows[0]["train/horizon"] == 3
    assert rows[1]["train/horizon"] > 3
    assert rows[1]["train/curriculum"] == pytest.approx(0.2)
    assert rows[1]["train/entropy_coefficient"] != rows[0]["train/entropy_coefficient"]
    assert -1.0 <= rows[1]["grad/halves_cosine"] <= 1.0
    saved = copy.deepcopy(shac.state_dict())
    expected = shac.update(2).metrics
    other = Shac(config, make_env(config.env, config.physics, 4, "cpu", 0))
    other.load_state_dict(saved)
    again = other.update(2).metrics
    assert {k: v for k, v in again.items() if not k.startswith("time/")} == {
        k: v for k, v in expected.items() if not k.startswith("time/")
    }
