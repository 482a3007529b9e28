"""What a member of a population takes over is drawn from the space's seed."""

import random
from types import SimpleNamespace
from typing import Any

import pytest
from ray.tune.schedulers import PopulationBasedTraining

from msk_ray.sweep.operators import parse_operator
from msk_ray.sweep.rules.population import PopulationBasedTraining as Spec
from msk_ray.tune.schedulers import Population

RANGES = {"shac.actor_lr": {"loguniform": [1e-4, 1e-2]}, "shac.horizon": {"randint": [4, 16]}}


class Member(SimpleNamespace):
    """As Ray's trials: a key of dictionaries."""

    __hash__ = object.__hash__  # type: ignore[assignment]


def exchanges(seed: int, order: list[int], monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """From whom each of the four worse members continues, and with which settings, when they report in this order."""
    members = [
        Member(config={"id": f"{n}", "params": {"shac.actor_lr": 9e-3, "shac.horizon": 4 + n}}) for n in range(8)
    ]
    operators = {key: parse_operator(key, value) for key, value in RANGES.items()}
    population = Population(Spec(kind="pbt", resample=0.5), 1000.0, operators, seed)
    exchanges = {}

    def exploit(self: Any, trial: Any, controller: Any, upper: list[Any], lower: list[Any]) -> None:
        (better,) = upper
        exchanges[trial.config["id"]] = better.config["id"], population._get_new_config(trial, better)

    monkeypatch.setattr(PopulationBasedTraining, "_checkpoint_or_exploit", exploit)
    for place in order:
        population._trial_state[members[place]] = SimpleNamespace(last_perturbation_time=100.0)
        population._checkpoint_or_exploit(members[place], None, members[4:], members[:4])
    return exchanges


def test_exchanges_repeat_whatever_the_order_and_what_else_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    random.seed(1)
    first = exchanges(0, [0, 1, 2, 3], monkeypatch)
    random.seed(2)
    assert exchanges(0, [3, 1, 0, 2], monkeypatch) == first
    assert exchanges(1, [0, 1, 2, 3], monkeypatch) != first
    assert len({better for better, _ in first.values()}) > 1, "not all from one"
    for member, (_, (config, _)) in first.items():
        assert config["id"] == member
        assert 1e-4 <= config["params"]["shac.actor_lr"] <= 1e-2
        assert 4 <= config["params"]["shac.horizon"] <= 16
        assert isinstance(config["params"]["shac.horizon"], int)
