"""Options of SHAC that are off by default: each changes what is learned, all resume, neutral values change nothing."""

from pathlib import Path
from typing import Any

import pytest
import torch

from msk_ray.algorithms.shac.schedules import contact_horizon
from msk_ray.config import ContactHorizon, overlay, parse_config
from msk_ray.errors import ConfigError
from msk_ray.training import Trainer

TINY: dict[str, Any] = {
    "env": {"name": "hopper", "nworld": 4, "episode_length": 12},
    "shac": {"horizon": 4, "critic_iterations": 6, "critic_batches": 2},
    "actor": {"hidden": [8]},
    "critic": {"hidden": [8]},
    "evaluation": {"interval": 1000, "nworld": 2, "steps": 2},
    "trial": {"epochs": 8},
    "execution": {"checkpoint_interval": 1000, "loggers": []},
}
OPTIONS: dict[str, dict[str, Any]] = {
    "contact": {"shac.horizon": {"kind": "contact", "start": 4, "shortest": 2, "longest": 8, "contact": 0.2}},
    "state std": {"actor.state_std": True},
    "weight decay": {"shac.weight_decay": 0.5},
    "mean": {"shac.actor_value": "mean", "critic.count": 2},
    "normalized entropy": {"shac.entropy": {"target": -0.5, "normalize": True}},
    "tolerance": {"shac.critic_tolerance": 1.0},
    "exploration": {"shac.exploration": {"start": 2.0, "end": 0.5, "epochs": 4}},
}
NEUTRAL: dict[str, dict[str, Any]] = {
    "tolerance": {"shac.critic_tolerance": 1e-12},
    "exploration": {"shac.exploration": {"start": 1.0, "end": 1.0, "epochs": 4}},
}
"""Values that amount to the option being off."""


def trained(changes: dict[str, Any], folder: Path, epochs: int) -> tuple[Trainer, list[dict[str, float]]]:
    trainer = Trainer(parse_config(overlay(TINY, changes)), folder, "cpu")
    return trainer, [trainer.run_epoch() for _ in range(epochs)]


def weights(trainer: Trainer) -> torch.Tensor:
    modules = (trainer.algorithm.network, trainer.algorithm.critic)
    return torch.cat([p.detach().flatten() for module in modules for p in module.parameters()])


def same(a: Trainer, b: Trainer) -> bool:
    first, second = weights(a), weights(b)
    return first.shape == second.shape and torch.equal(first, second)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    """One epoch without any of them."""
    return trained({}, tmp_path_factory.mktemp("plain"), 1)[0]


@pytest.mark.parametrize("name", sorted(set(OPTIONS) - {"contact"}))
def test_an_option_changes_what_is_learned(name: str, plain: Trainer, tmp_path: Path) -> None:
    trainer, _ = trained(OPTIONS[name], tmp_path, 1)
    assert weights(trainer).isfinite().all()
    assert not same(trainer, plain)


@pytest.mark.long
def test_options_resume(tmp_path: Path) -> None:
    changes: dict[str, Any] = {}
    for name, option in OPTIONS.items():
        changes |= {} if name == "normalized entropy" else option  # of exploration and entropy, only one may be
    trainer, _ = trained(changes, tmp_path / "a", 2)
    path = trainer.save()
    again = Trainer(parse_config(overlay(TINY, changes)), tmp_path / "b", "cpu")
    again.restore(path)
    for goes_on in (trainer, again):
        for _ in range(2):
            goes_on.run_epoch()
    assert same(again, trainer)


@pytest.mark.parametrize("name", sorted(NEUTRAL))
def test_an_option_at_its_neutral_value_changes_no_bit(name: str, plain: Trainer, tmp_path: Path) -> None:
    assert same(trained(NEUTRAL[name], tmp_path, 1)[0], plain)


def test_the_horizon_follows_contact(tmp_path: Path) -> None:
    config = ContactHorizon(**OPTIONS["contact"]["shac.horizon"])
    rows = trained(OPTIONS["contact"], tmp_path, 3)[1]
    length, multiplier = 4.0, 0.0
    for row in rows:
        assert row["train/horizon"] == round(length)
        length, multiplier = contact_horizon(config, length, multiplier, row["train/contact"])
    assert len({row["train/contact"] for row in rows}) == 3
    assert len({row["train/horizon"] for row in rows}) > 1


def test_a_body_at_rest_has_a_contact_force_of_its_weight(tmp_path: Path) -> None:
    horizon = {"kind": "contact", "start": 4, "shortest": 4, "longest": 4, "contact": 1.0}
    still = {"env": {"name": "cheetah", "nworld": 2, "stochastic_reset": False}, "shac.horizon": horizon}
    trainer = Trainer(
        parse_config(overlay(TINY, still | {"actor.log_std": -9.0, "shac.actor_lr": 1e-9})), tmp_path, "cpu"
    )
    env = trainer.algorithm.env
    with torch.no_grad():
        trainer.algorithm.actor.mean[-1].weight.zero_()
        for _ in range(90):
            env.step(torch.zeros(2, 6))
    assert trainer.run_epoch()["train/contact"] == pytest.approx(1.0, rel=0.02)


def test_the_actor_may_believe_the_mean_of_two_critics(tmp_path: Path) -> None:
    rows = {
        value: trained({"shac.actor_value": value, "critic.count": 2}, tmp_path / value, 1)[1][0]
        for value in ("smaller", "mean")
    }
    assert rows["mean"]["train/actor_loss"] < rows["smaller"]["train/actor_loss"]
    assert rows["mean"]["train/value"] == rows["smaller"]["train/value"], "that of the targets"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shac.actor_value": "mean"}, "write critic.count: 2"),
        ({"shac.exploration": {"start": 1, "end": 0, "epochs": 4}, "shac.entropy": {}}, "leave one out"),
        (
            {"env": {"name": "cartpole"}, "shac.horizon": {"kind": "contact", "start": 4, "contact": 1.0}},
            "cartpole has no contacts",
        ),
    ],
)
def test_options_without_a_meaning_are_refused(changes: dict[str, Any], message: str) -> None:
    base = {**TINY, "env": {"name": "hopper", "nworld": 4}}
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        parse_config(overlay(base, changes))
