"""Jacobians, applied forces and randomized parameters on a CUDA device, beside the CPU; run with `pytest -m gpu`."""

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from oracle import INPUTS
from scenes import ant, ant_points

from msk_ray.config import parse_config
from msk_ray.step import Simulation
from msk_ray.step.forward.parameters import PARAMETERS, names_of
from msk_ray.training import Trainer

pytestmark = pytest.mark.gpu


def in_contact(device: str) -> tuple[mujoco.MjModel, Simulation, list[torch.Tensor]]:
    """An ant, its simulation and (ctrl, qpos, qvel, act) of six states in contact."""
    model = ant("elliptic")
    points = ant_points(model, 6, seed=2)
    sim = Simulation(model, 6, 4, device=device, tolerance=1e-9)
    inputs = [
        torch.tensor(np.stack([getattr(p, n) for p in points]), dtype=torch.float32, device=device) for n in INPUTS
    ]
    return model, sim, inputs


def measured(device: str) -> dict[str, torch.Tensor]:
    """A, B and gradients of an ant in contact whose worlds differ in friction, under forces from outside."""
    model, sim, inputs = in_contact(device)
    friction = torch.tensor(model.geom_friction, dtype=torch.float32).repeat(6, 1, 1)
    friction[:, :, 0] = torch.linspace(0.4, 1.2, 6)[:, None]
    parameters = {"geom_friction": friction.to(device)}
    a, b, _ = sim.linearize(*inputs, parameters=parameters)
    generator = torch.Generator().manual_seed(0)
    xfrc = (5.0 * torch.randn(6, model.nbody, 6, generator=generator)).to(device).requires_grad_()
    end = sim.step(*inputs, xfrc_applied=xfrc, parameters=parameters)
    end = sim.step(inputs[0], *end)
    (gradient,) = torch.autograd.grad(end.qvel.square().sum(), xfrc)
    again = sim.linearize(*inputs).A
    return {"A": a.cpu(), "B": b.cpu(), "xfrc": gradient.cpu(), "A of the model's own friction": again.cpu()}


@pytest.mark.usefixtures("cpu_kernels")
def test_jacobians_and_forces_are_those_of_the_cpu() -> None:
    here, there = measured("cuda"), measured("cpu")
    for name, value in there.items():
        assert (here[name] - value).norm() <= 1e-3 * value.norm(), name
    assert (there["A"] - there["A of the model's own friction"]).norm() > 1e-3 * there["A"].norm()


def of_all_parameters(device: str) -> dict[str, torch.Tensor]:
    """Gradients of all parameters of an ant in contact, whose stages share several CUDA streams."""
    model, sim, inputs = in_contact(device)
    values = {}
    for name in names_of(model):
        value = torch.as_tensor(PARAMETERS[name].value(model), dtype=torch.float32, device=device)
        values[name] = value.expand(6, *value.shape).clone().requires_grad_()
    end = sim.step(*inputs, parameters=values)
    end = sim.step(inputs[0], *end, parameters=values)
    (end.qvel.square().sum() + end.qpos.square().sum()).backward()
    return {name: value.grad.cpu() for name, value in values.items() if value.grad is not None}


@pytest.mark.usefixtures("cpu_kernels")
def test_gradients_of_parameters_are_those_of_the_cpu() -> None:
    here, there = of_all_parameters("cuda"), of_all_parameters("cpu")
    assert here.keys() == there.keys()
    for name, value in there.items():
        assert (here[name] - value).norm() <= 2e-3 * value.norm() + 1e-6, name


def test_a_trial_with_drawn_parameters_trains(tmp_path: Path) -> None:
    config = parse_config(
        {
            "env": {"name": "ant", "nworld": 16, "episode_length": 6},
            "physics": {
                "randomize": {"pair_friction": {"low": 0.5, "high": 1.5}, "body_mass": {"low": 0.8, "high": 1.2}}
            },
            "shac": {"horizon": 4, "critic_iterations": 2},
            "evaluation": {"nworld": 4, "steps": 10, "interval": 2},
            "trial": {"epochs": 4},
        }
    )
    trainer = Trainer(config, tmp_path, "cuda")
    rows = [trainer.run_epoch() for _ in range(4)]
    trainer.close()
    assert all(math.isfinite(row["grad/actor_norm"]) for row in rows)
    assert len({row["randomize/body_mass_max"] for row in rows}) > 1
