"""The policy gradient through many env steps, compared with float64 central differences of the whole loss."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from msk_ray.step.autograd import Backward, Simulation
from msk_ray.step.check.oracle import Oracle, Point

_STEP = 1e-6
"""Displacement of a policy parameter; the loss is smooth on a scale of 1e-3 and float64 rounds at 1e-16."""


@dataclass(frozen=True)
class ChainComparison:
    """One world's gradient of a rollout's loss with respect to all policy parameters."""

    horizon: int
    world: int
    rel_error: float
    """‖g − g_ref‖ / ‖g_ref‖."""
    cosine: float
    norm_ratio: float
    """‖g‖ / ‖g_ref‖."""
    norm: float
    """‖g_ref‖."""


class ChainPolicy(nn.Module):
    """ctrl = c + s tanh(MLP(qpos, qvel)): a small feedback policy over the raw state, 8 hidden units.

    s is ½ about c = 0, but ¼ about ½ for a muscle, whose activation clamps its excitation to [0, 1].
    """

    centre: Tensor
    span: Tensor

    def __init__(self, model: mujoco.MjModel, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.first = nn.Linear(model.nq + model.nv, 8)
        self.last = nn.Linear(8, model.nu)
        muscle = torch.from_numpy(model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_MUSCLE))
        self.register_buffer("centre", torch.where(muscle, 0.5, 0.0))
        self.register_buffer("span", torch.where(muscle, 0.25, 0.5))
        for layer in (self.first, self.last):
            nn.init.normal_(layer.weight, std=layer.in_features**-0.5, generator=generator)
            nn.init.zeros_(layer.bias)

    def forward(self, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Controls (W, nu)."""
        hidden = torch.tanh(self.first(torch.cat((qpos, qvel), dim=-1)))
        return self.centre + self.span * torch.tanh(self.last(hidden))


def check_chain(
    model: mujoco.MjModel,
    backward: Backward,
    points: Sequence[Point],
    horizons: Sequence[int],
    *,
    substeps: int,
    seed: int = 0,
    device: str = "cpu",
    solver_tolerance: float | None = 1e-9,
) -> list[ChainComparison]:
    """Gradient of Σ_t ⟨w, qvel_t⟩ over rollouts of a feedback policy, per starting point and horizon.

    w is a random unit vector. The reference displaces every policy parameter and rolls C MuJoCo out twice.

    Args:
        model: the compiled model.
        backward: a mode that no Simulation uses yet.
        points: starting states; their controls are ignored.
        horizons: env steps H of each rollout.
        substeps: physics steps per env step.
        seed: seed of the policy and of w.
        device: where Warp runs.
        solver_tolerance: tolerance of Warp's solver.
    """
    policy = ChainPolicy(model, seed)
    weights = np.random.default_rng(seed).normal(size=model.nv)
    weights /= np.linalg.norm(weights)
    sim = Simulation(model, 1, substeps, backward, device, tolerance=solver_tolerance)
    oracle = Oracle(model, substeps)
    exact = ChainPolicy(model, seed).double()
    exact.load_state_dict({name: value.double() for name, value in policy.state_dict().items()})
    policy.to(sim.device)
    results = []
    for world, point in enumerate(points):
        for horizon in horizons:
            gradient = _tape_gradient(sim, policy, point, horizon, weights)
            expected = _reference_gradient(oracle, exact, point, horizon, weights)
            norm = float(np.linalg.norm(expected))
            results.append(
                ChainComparison(
                    horizon,
                    world,
                    float(np.linalg.norm(gradient - expected)) / norm,
                    float(gradient @ expected) / (float(np.linalg.norm(gradient)) * norm),
                    float(np.linalg.norm(gradient)) / norm,
                    norm,
                )
            )
    return results


def _tape_gradient(
    sim: Simulation, policy: ChainPolicy, point: Point, horizon: int, weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    def tensor(value: NDArray[np.float64]) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float32, device=sim.device)[None]

    qpos, qvel, act = tensor(point.qpos), tensor(point.qvel), tensor(point.act)
    loss = torch.zeros((), device=sim.device)
    for _ in range(horizon):
        qpos, qvel, act = sim.step(policy(qpos, qvel), qpos, qvel, act)
        loss = loss + (qvel * tensor(weights)).sum()
    gradients = torch.autograd.grad(loss, list(policy.parameters()))
    return torch.cat([g.flatten() for g in gradients]).double().cpu().numpy()


@torch.no_grad()
def _reference_gradient(
    oracle: Oracle, policy: ChainPolicy, point: Point, horizon: int, weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    start = nn.utils.parameters_to_vector(policy.parameters())

    def loss_at(vector: Tensor) -> float:
        nn.utils.vector_to_parameters(vector, policy.parameters())
        state, loss = point, 0.0
        for _ in range(horizon):
            ctrl = policy(torch.from_numpy(state.qpos)[None], torch.from_numpy(state.qvel)[None])[0].numpy()
            state = oracle.step(Point(ctrl, state.qpos, state.qvel, state.act))
            loss += float(state.qvel @ weights)
        return loss

    steps = _STEP * torch.eye(len(start), dtype=torch.float64)
    slopes = [(loss_at(start + step) - loss_at(start - step)) / (2.0 * _STEP) for step in steps]
    nn.utils.vector_to_parameters(start, policy.parameters())
    return np.array(slopes)
