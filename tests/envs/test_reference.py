"""Scores are taken under the reference reward, and under nothing else that differs from the trial."""

from typing import Any

import pytest

from msk_ray.config import EnvSettings, Reward, parse_config
from msk_ray.config.physics import STEPPING
from msk_ray.config.sections import Section
from msk_ray.envs import Env, env_class
from msk_ray.legs.config import LegReward
from msk_ray.legs.myoleg.config import MyoLegSettings


class _HopperReward(Reward):
    speed: float = 2.0


class _HopperSettings(EnvSettings):
    reads_physics = STEPPING

    episode_length: int = 10
    model: str = "hopper.xml"
    height: float = 0.5
    reward: _HopperReward = _HopperReward()


def test_a_model_path_survives_scoring() -> None:
    """Of an environment that says nothing about it: the base class must be right."""
    trained = _HopperSettings(name="hopper", model="own.xml", height=0.7, nworld=3, reward=_HopperReward(speed=9.0))
    reference = Env.reference_settings(trained)
    assert reference == _HopperSettings(name="hopper", model="own.xml", height=0.7, nworld=3)
    legs = MyoLegSettings(name="myoleg", model="own.xml", target_speed=0.5, reward=LegReward(sway=1.0))
    assert Env.reference_settings(legs) == MyoLegSettings(name="myoleg", model="own.xml", target_speed=0.5)


_OTHERS: dict[str, Any] = {"speed_range": (0.5, 1.0), "gait_worlds": 2, "joint_limit_epochs": 10}
"""Of fields whose default does not tell the type."""


def _other(field: str, value: Any) -> Any:
    """Another value of the same type."""
    if field in _OTHERS:
        return _OTHERS[field]
    match value:
        case bool():
            return not value
        case int() | float():
            return value / 2 if value else 0.25
        case None:
            return "own.xml"
    return value


@pytest.mark.parametrize(
    "name", ["cartpole", "ant", "hopper", "cheetah", "humanoid", "myoleg26", "myoleg", "myosuite_walk"]
)
def test_only_the_reward_is_reset(name: str) -> None:
    default = parse_config({"env": {"name": name}}).env
    env = env_class(default)
    changes = {
        field: _other(field, getattr(default, field))
        for field in env.Settings.model_fields
        if not isinstance(getattr(default, field), str | Section)
    }
    weights = {weight: _other(weight, value) for weight, value in default.reward.model_dump().items()}
    changes |= {"name": name, "nworld": 3, "episode_length": 7, "reward": weights}
    trained = env.Settings.model_validate(changes)
    reference = env.reference_settings(trained)
    assert reference.reward == default.reward != trained.reward
    # Help for training that scores are without; they are taken at target_speed.
    own = {"reward", "assist", "smoothing", "speed_range", "cycle", "joint_limit_epochs"}
    assert reference.model_dump(exclude=own) == trained.model_dump(exclude=own)
