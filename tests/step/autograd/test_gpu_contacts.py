"""Gradients through contacts of convex geoms and height fields on a CUDA device; run with `pytest -m gpu`."""

import numpy as np
import pytest
import torch
from oracle import INPUTS
from test_adjoint_contacts import falling, landing_points

from msk_ray.step import Simulation, TapePerSubstep

pytestmark = pytest.mark.gpu


def gradients(shape: str, ground: str, device: str) -> torch.Tensor:
    """Of one weighted sum of the state after 4 substeps, by (qpos, qvel), in 6 states in contact."""
    model = falling(shape, ground)
    points = landing_points(model, 6, ground == "hills")
    sim = Simulation(model, 6, 4, TapePerSubstep(), device, tolerance=1e-9)
    inputs = [
        torch.tensor(np.stack([getattr(p, n) for p in points]), dtype=torch.float32, device=device) for n in INPUTS
    ]
    inputs[1].requires_grad_()
    inputs[2].requires_grad_()
    end = sim.step(*inputs)
    found = torch.autograd.grad(end.qvel.square().sum() + end.qpos.sum(), inputs[1:3])
    return torch.cat(found, dim=1).cpu()


@pytest.mark.usefixtures("cpu_kernels")
@pytest.mark.parametrize(
    ("shape", "ground"),
    [("mesh", "mesh"), ("mesh", "box"), ("capsule", "cylinder"), ("box", "box"), ("sphere", "hills")],
)
def test_contacts_are_those_of_the_cpu(shape: str, ground: str) -> None:
    here, there = gradients(shape, ground, "cuda"), gradients(shape, ground, "cpu")
    error = (here - there).norm(dim=1) / there.norm(dim=1)
    assert error.median() < 1e-3
