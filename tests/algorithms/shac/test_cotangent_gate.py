"""The per-world bound on the state cotangent."""

import torch

from msk_ray.algorithms.shac.cotangent_gate import CotangentGate
from msk_ray.envs import EnvState
from msk_ray.step import StepState


def pulled(gate: CotangentGate, cotangent: torch.Tensor) -> torch.Tensor:
    qpos = torch.zeros_like(cotangent).requires_grad_()
    empty = torch.zeros(len(cotangent), 0)
    passed = gate(EnvState(StepState(qpos, empty, empty), empty, empty, empty))
    passed.physics.qpos.backward(cotangent)
    return qpos.grad


def test_long_cotangents_are_shortened_and_keep_their_direction() -> None:
    gate = CotangentGate(1.0, 3, torch.device("cpu"))
    out = pulled(gate, torch.tensor([[3.0, 4.0], [0.3, 0.4], [0.0, 0.0]]))
    assert torch.allclose(out, torch.tensor([[0.6, 0.8], [0.3, 0.4], [0.0, 0.0]]))
    statistics = gate.record().statistics(unit=0.5)
    assert statistics.norms is not None
    assert torch.isclose(statistics.norms.clipped_share, torch.tensor(1 / 3))
    assert torch.isclose(statistics.norms.maximum, torch.tensor(10.0))
    assert torch.isclose(statistics.norms.median, torch.tensor(1.0))
    assert statistics.metrics()["grad/state_max"] == statistics.norms.maximum


def test_a_world_that_is_not_finite_passes_nothing_and_is_counted() -> None:
    for bound in (None, 1.0):
        gate = CotangentGate(bound, 2, torch.device("cpu"))
        out = pulled(gate, torch.tensor([[float("nan"), 1.0], [0.5, 0.0]]))
        assert torch.allclose(out, torch.tensor([[0.0, 0.0], [0.5, 0.0]]))
        assert gate.record().statistics(1.0).nonfinite_share == 0.5


def test_nothing_is_bounded_without_a_bound() -> None:
    gate = CotangentGate(None, 1, torch.device("cpu"))
    assert torch.allclose(pulled(gate, torch.tensor([[1e6, 0.0]])), torch.tensor([[1e6, 0.0]]))


def test_an_action_whose_cotangent_is_not_finite_loses_its_world_only() -> None:
    gate = CotangentGate(None, 2, torch.device("cpu"))
    action = torch.zeros(2, 3, requires_grad=True)
    gate.screen(action).backward(torch.tensor([[1.0, float("inf"), 2.0], [1.0, 2.0, 3.0]]))
    assert torch.equal(action.grad, torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]))
    assert gate.record().statistics(unit=1.0).metrics() == {"grad/nonfinite_share": 0.5}
