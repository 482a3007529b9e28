"""The audit of learned models, in tiny size, and what it rests on."""

import json
import runpy
import sys
from pathlib import Path
from typing import Any

import matplotlib
import pytest
import torch

from msk_ray.step import StepState

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "docs" / "examples" / "world_model_audit.py"


@pytest.fixture
def audit() -> dict[str, Any]:
    """The names of the example."""
    return runpy.run_path(str(EXAMPLE))


def states(count: int) -> StepState:
    qpos = torch.randn(count, 9)
    qpos[:, 3:7] /= qpos[:, 3:7].norm(dim=-1, keepdim=True)
    return StepState(qpos, torch.randn(count, 8), torch.zeros(count, 0))


def test_a_displacement_is_found_again_and_features_ignore_place_and_heading(audit: dict[str, Any]) -> None:
    torch.manual_seed(0)
    state, by = states(5), 0.3 * torch.randn(5, 16)
    assert torch.allclose(audit["difference"](state, audit["displaced"](state, by)), by, atol=1e-5)
    half = torch.tensor(0.4)
    heading = torch.tensor([[torch.cos(half), 0.0, 0.0, torch.sin(half)]]).expand(5, 4)
    place = state.qpos[:, :3] + torch.tensor([1.0, 2.0, 0.0])
    orientation = audit["quat_multiply"](heading, state.qpos[:, 3:7])
    turned = StepState(torch.cat((place, orientation, state.qpos[:, 7:]), -1), state.qvel.clone(), state.act)
    turned.qvel[:, :3] = audit["quat_rotate"](heading, state.qvel[:, :3])
    assert torch.allclose(audit["features"](turned), audit["features"](state), atol=1e-5)


def test_fitting_to_jacobians_has_a_finite_slope(audit: dict[str, Any]) -> None:
    torch.manual_seed(0)
    state = states(8)
    data = audit["Data"](state.qpos, state.qvel, *(torch.randn(8, n) for n in (2, 16, 16, 16, 2)))
    model = audit["WorldModel"](data, 8, 1)
    error, wrong = audit["losses"](model, data, audit["Units"].of(data), True)
    (error + wrong).backward()
    assert wrong > 0.0
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


def test_equal_gradients_have_cosine_and_size_one(audit: dict[str, Any]) -> None:
    exact = [torch.randn(4, h, 3) for h in (1, 2)]
    double = audit["Gradients"]([2.0 * g for g in exact], exact, [])
    rows = list(audit["compared"](double, audit["Gradients"](exact, exact, []), [1, 2]))
    assert len(rows) == 8
    for row in rows:
        assert row["worlds"] == 4
        assert row["cosine"] == pytest.approx([1.0] * 3)
        assert row["size"] == pytest.approx([2.0 if row["target"] == "reward" else 1.0] * 3)


@pytest.mark.long
def test_the_audit_runs(monkeypatch: Any, capsys: Any, tmp_path: Path) -> None:
    matplotlib.use("Agg")
    tiny = ("--transitions", "60", "--horizons", "1", "2", "--worlds", "4", "--updates", "2", "--width", "16")
    policy = ROOT / "policies" / "go1_velocity.pt"
    changed = ("--set", "env.episode_length=500")
    monkeypatch.setattr(sys, "argv", [EXAMPLE.name, str(policy), "--output", str(tmp_path), *changed, *tiny])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert "written to" in capsys.readouterr().out
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert len(rows) == 2 * 2 * 2 * 2 * 2 * 2  # fits, states, rollouts, targets, actions, horizons
    assert all(row["worlds"] for row in rows)
    assert (tmp_path / "audit.png").stat().st_size > 10_000
    assert "| on | imagined | 60 | and Jacobians |" in (tmp_path / "table.md").read_text()
