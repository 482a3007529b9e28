"""What must hold on a CUDA device; run with `pytest -m gpu`."""

from pathlib import Path

import pytest
import torch

from msk_ray.config import AntEnvConfig, Config, PhysicsConfig, parse_config
from msk_ray.envs import make_env
from msk_ray.training import Trainer, read_metrics

pytestmark = pytest.mark.gpu


def rollout(device: str, backward: str) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Final qpos, total reward and its gradient with respect to a constant action, over three env steps."""
    env = make_env(AntEnvConfig(name="ant", stochastic_reset=False), PhysicsConfig(backward=backward), 6, device, 0)
    generator = torch.Generator().manual_seed(1)
    qvel = 0.3 * torch.randn(6, 14, generator=generator)
    env.state = env.state._replace(physics=env.state.physics._replace(qvel=qvel.to(device)))
    action = (0.3 * torch.randn(6, 8, generator=generator)).to(device).requires_grad_()
    reward = torch.zeros((), device=device)
    for _ in range(3):
        reward = reward + env.step(action).reward.sum()
    reward.backward()
    env.sim.diagnostics()
    return env.state.physics.qpos.detach().cpu(), reward.detach().cpu(), action.grad.cpu()


@pytest.mark.parametrize("backward", ["tape_per_substep", "tape_all", "fd_jacobian"])
def test_cpu_and_gpu_agree(backward: str) -> None:
    on_cpu = rollout_on_cpu() if backward == "tape_per_substep" else rollout("cuda", "tape_per_substep")
    on_gpu = rollout("cuda", backward)
    tolerance = 2e-2 if backward == "fd_jacobian" else 1e-3
    assert torch.allclose(on_gpu[0], on_cpu[0], atol=1e-4)
    assert torch.allclose(on_gpu[1], on_cpu[1], rtol=1e-4)
    assert (on_gpu[2] - on_cpu[2]).norm() <= tolerance * on_cpu[2].norm()


def rollout_on_cpu() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The CPU's answer; Warp's CPU compiler is an optional part of an installation."""
    try:
        return rollout("cpu", "tape_per_substep")
    except (OSError, RuntimeError) as error:
        pytest.skip(f"Warp cannot compile for the CPU here: {error}")


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
