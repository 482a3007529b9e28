"""Env steps of an evaluation as one recording: on a CPU, one that runs the work again each time."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from msk_ray.config import Config, parse_config
from msk_ray.training import evaluation, recorded_evaluation
from msk_ray.training.evaluation import Evaluator
from msk_ray.training.evaluation_tally import Episodes


class Again:
    """Stands for a recording, which runs nothing when it is made, and the work in each replay."""

    made = 0

    def __init__(self, work: Callable[[], None], stream: Any) -> None:
        self._work = work
        type(self).made += 1

    def replay(self) -> None:
        self._work()


def settings(**env: Any) -> Config:
    return parse_config(
        {
            "env": {"name": "ant", **env},
            "physics": {"variant": "matched"},
            "execution": {"solver_kernels": "fused"},
            "evaluation": {"nworld": 3, "steps": 90},
        }
    )


def lift(obs: torch.Tensor) -> torch.Tensor:
    return 0.1 * torch.sin(obs[:, :8])


def push(obs: torch.Tensor) -> torch.Tensor:
    return torch.tanh(obs[:, 5:13])


def assert_equal(found: list[Episodes], expected: list[Episodes]) -> None:
    for one, other in zip(found, expected, strict=True):
        for name in ("score", "length", "fell", "diverged", "terms"):
            assert torch.equal(getattr(one, name), getattr(other, name)), name
        assert {n: v.tolist() for n, v in one.outcomes.items()} == {n: v.tolist() for n, v in other.outcomes.items()}


def episodes(config: Config, recorded: bool, monkeypatch: pytest.MonkeyPatch) -> list[Episodes]:
    monkeypatch.setattr(recorded_evaluation, "Recording", Again)
    monkeypatch.setattr(Evaluator, "_can_record", lambda _: recorded)
    evaluator = Evaluator(config, "cpu", policies=2)
    evaluator._streams = [None]  # type: ignore[list-item]
    group = evaluation.PolicyGroup
    monkeypatch.setattr(evaluation, "PolicyGroup", lambda policies, worlds, env, _: group(policies, worlds, env, []))
    return evaluator._episodes([lift, push])


@pytest.mark.parametrize("name", ["ant", "remembering:Remembering"])
def test_it_counts_what_steps_one_by_one_count(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Again, "made", 0)
    found, expected = (episodes(settings(name=name), recorded, monkeypatch) for recorded in (True, False))
    assert Again.made == 1
    assert_equal(found, expected)


@pytest.mark.gpu
@pytest.mark.filterwarnings("error:.*cannot be recorded")
@pytest.mark.parametrize("name", ["ant", "myoleg26", "remembering:Remembering"])
@pytest.mark.parametrize("policies", [1, 3])
def test_recorded_steps_on_a_gpu_have_the_bits_of_steps_one_by_one(
    name: str, policies: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = parse_config(
        {
            "env": {"name": name},
            "evaluation": {"nworld": 8, "steps": 120},
            "execution": {"solver_kernels": "fused", "deterministic": True},
        }
    )
    evaluator = Evaluator(config, "cuda:0", policies=policies)
    made: list[object] = []
    record = evaluation.recorded_step
    monkeypatch.setattr(evaluation, "recorded_step", lambda *args: made.append(record(*args)) or made[-1])

    def act(k: int) -> evaluation.Policy:
        return lambda obs: 0.3 * torch.sin(obs[:, :1] + k + torch.arange(evaluator.env.action_size, device=obs.device))

    acting = [act(k) for k in range(policies)]
    found = evaluator._episodes(acting)
    again = evaluator._episodes(acting)
    monkeypatch.setattr(Evaluator, "_can_record", lambda _: False)
    expected = evaluator._episodes(acting)
    assert len(made) == 2
    assert None not in made
    assert_equal(found, expected)
    assert_equal(again, expected)
