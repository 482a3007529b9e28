"""What must hold on a CUDA device; run with `pytest -m gpu`."""

import warnings
from pathlib import Path

import pytest
import torch
from scenes import studded_plate
from test_adjoint_features import SCENES

from msk_ray.algorithms import algorithm_class
from msk_ray.config import Config, PhysicsConfig, parse_config
from msk_ray.envs import make_env
from msk_ray.envs.ant.config import AntSettings
from msk_ray.envs.ant.model import build_ant
from msk_ray.errors import SimulationError
from msk_ray.step import Simulation, TapePerSubstep, check_gradients
from msk_ray.step.forward.capacity import Capacity
from msk_ray.training import Evaluator, Trainer, read_metrics

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("variant", ["matched", "matched_hard_friction"])
@pytest.mark.parametrize("mode", ["tape_per_substep", "tape_all"])
def test_gradients_of_an_ant_are_those_of_float64(mode: str, variant: str) -> None:
    model = build_ant(AntSettings(name="ant"), PhysicsConfig(variant=variant))
    report = check_gradients(Simulation(model, 8, 4, mode, "cuda"), states=("standing", "contact"))
    assert report.checked >= 12
    assert report.max_rel_error <= 1e-2


@pytest.mark.parametrize(
    "name",
    [
        *("weld_mocap", "sphere_wrap_inside", "cylinder_wrap_inside", "fast_spinning_free", "fast_spinning_fluid"),
        *("rk4_spinning_free", "rk4_muscle", "rk4_activations", "refsite", "slider_crank"),
    ],
)
def test_gradients_of_a_feature_are_those_of_float64(name: str) -> None:
    report = check_gradients(Simulation(SCENES[name](), 8, 4, device="cuda", tolerance=1e-9), states=("random",))
    assert report.checked >= 6
    assert report.max_rel_error <= 1e-3


def rollout(backward: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Total reward of three env steps and its gradient with respect to a constant action."""
    env = make_env(AntSettings(name="ant", stochastic_reset=False), PhysicsConfig(backward=backward), 6, "cuda", 0)
    generator = torch.Generator().manual_seed(1)
    qvel = 0.3 * torch.randn(6, 14, generator=generator)
    env.state = env.state._replace(physics=env.state.physics._replace(qvel=qvel.cuda()))
    action = (0.3 * torch.randn(6, 8, generator=generator)).cuda().requires_grad_()
    reward = torch.zeros((), device="cuda")
    for _ in range(3):
        reward = reward + env.step(action).reward.sum()
    reward.backward()
    env.sim.diagnostics()
    return reward.detach(), action.grad


@pytest.mark.parametrize(("mode", "tolerance"), [("tape_all", 1e-4), ("fd_jacobian", 2e-2)])
def test_modes_agree_over_several_env_steps(mode: str, tolerance: float) -> None:
    reward, gradient = rollout(mode)
    expected_reward, expected = rollout("tape_per_substep")
    assert torch.allclose(reward, expected_reward, rtol=1e-5)
    assert (gradient - expected).norm() <= tolerance * expected.norm()


def test_a_trial_trains_and_resumes(tmp_path: Path) -> None:
    config: Config = parse_config(
        {
            "env": {"name": "ant", "nworld": 16},
            "shac": {"horizon": 4, "critic_iterations": 2},
            "evaluation": {"nworld": 4, "steps": 10, "interval": 2},
            "trial": {"epochs": 4, "checkpoint_interval": 2},
        }
    )
    first = Trainer(config, tmp_path, "cuda")
    for _ in range(3):
        first.run_epoch()
    first.close()
    second = Trainer(config, tmp_path, "cuda")
    path, _ = second.restore_latest()
    assert path is not None
    assert path.name == "epoch_000002.pt"
    while not second.finished:
        second.run_epoch()
    second.close()
    assert [row["epoch"] for row in read_metrics(tmp_path / "metrics.jsonl")] == list(range(5))


def lying(sim: Simulation) -> dict[str, torch.Tensor]:
    """The plate on the ground in world 0, in the air in the others; its control wants a gradient."""
    qpos, qvel, act = sim.initial_state()
    qpos[0, 2] = 0.0495
    ctrl = torch.zeros(sim.nworld, sim.model.nu, device=sim.device, requires_grad=True)
    return {"ctrl": ctrl, "qpos": qpos, "qvel": qvel, "act": act}


def test_lost_rows_are_nan_at_once_and_an_error_in_backward() -> None:
    sim = Simulation(studded_plate(), 3, 2, TapePerSubstep(), "cuda", capacity=Capacity(200, 64))
    end = sim.step(**lying(sim))
    assert end.qvel[0].isnan().all()
    assert end.qvel[1:].isfinite().all()
    with pytest.raises(SimulationError, match="njmax"):
        end.qvel.sum().backward()


def test_lost_rows_are_an_error_at_the_next_step_that_comes_after_them() -> None:
    sim = Simulation(studded_plate(), 3, 2, None, "cuda", capacity=Capacity(200, 64))
    start = {name: value.detach() for name, value in lying(sim).items()}
    sim.step(**start)
    torch.cuda.synchronize()
    with pytest.raises(SimulationError, match="njmax"):
        sim.step(**start)
    sim.step(**start)
    with pytest.raises(SimulationError, match="njmax"):
        sim.diagnostics()


def test_default_room_is_enough_on_a_gpu_and_grows_between_epochs() -> None:
    sim = Simulation(studded_plate(), 64, 2, TapePerSubstep(), "cuda")
    start = lying(sim)
    start["qpos"][:, 2] = 0.0495
    end = sim.step(**start)
    end.qvel.sum().backward()
    assert end.qvel.isfinite().all()
    before = sim.capacity
    assert 0.4 < sim.diagnostics()["rows_share"] <= 1.0
    sim.reserve(before._replace(rows=2 * before.rows))
    again = sim.step(**start)
    assert torch.allclose(again.qvel, end.qvel, atol=1e-5)
    again.qvel.sum().backward()


def test_policies_scored_together_get_the_scores_of_each_alone() -> None:
    """Few steps, because a GPU's sums differ from run to run, and an ant's motion amplifies that."""
    config = parse_config({"env": {"name": "ant"}, "evaluation": {"nworld": 16, "steps": 20}})
    alone, together = Evaluator(config, "cuda"), Evaluator(config, "cuda", policies=5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # one says that the policies could not be recorded
        networks = []
        for seed in range(4):
            other = config.model_copy(update={"trial": config.trial.model_copy(update={"seed": seed})})
            made = algorithm_class(other).policy_network(other, alone.env.obs_size, alone.env.action_size)
            networks.append(made.cuda())
        found = together.run(networks)
    for figures, network in zip(found, networks, strict=True):
        (expected,) = alone.run([network])
        assert figures == pytest.approx(expected, rel=1e-3, abs=1e-3)
    assert len({round(figures["score"], 3) for figures in found}) == 4


def test_a_trial_that_scores_policies_together_has_all_scores(tmp_path: Path) -> None:
    config = parse_config(
        {
            "env": {"name": "ant", "nworld": 16},
            "shac": {"horizon": 4, "critic_iterations": 2},
            "evaluation": {"nworld": 4, "steps": 60, "interval": 2},
            "trial": {"epochs": 9, "checkpoint_interval": 4},
        }
    )
    trainer = Trainer(config, tmp_path, "cuda", 10)
    while not trainer.finished:
        trainer.run_epoch()
    trainer.close()
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert [row["epoch"] for row in rows if "eval/score" in row] == [0, 2, 4, 6, 8, 9]
    assert trainer.best_score == max(row["eval/score"] for row in rows[1:] if "eval/score" in row)
