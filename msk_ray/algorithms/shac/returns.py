"""Returns over a rollout. Pure functions; axes H horizon, W worlds.

`terminated[t]` says that nothing follows step t; `done[t]` that the episode ended at t, by termination or by the
time limit. `next_values[t]` is the value of the state reached by step t, before any reset.
"""

import torch
from torch import Tensor


def discounts(done: Tensor, gamma: float) -> Tensor:
    """γᵏ, shape (H, W), with k the number of steps since the rollout's start or the world's last reset."""
    horizon = done.shape[0]
    steps = torch.arange(horizon, device=done.device)[:, None]
    # First step of the episode that step t belongs to: one past the latest done before t.
    starts = torch.cummax((steps + 1).expand_as(done).masked_fill(~done, 0), dim=0).values
    first = torch.cat((torch.zeros_like(starts[:1]), starts[:-1]))
    return gamma ** (steps - first).to(torch.get_default_dtype())


def actor_loss(rewards: Tensor, next_values: Tensor, terminated: Tensor, done: Tensor, gamma: float) -> Tensor:
    """The negated mean H-step return (SHAC equation 5), a scalar.

    Every piece of an episode inside the rollout counts Σ γᵏ r plus, unless it terminated, γᵏ⁺¹ V of the state in which
    it ended: at the episode's end or at the horizon. Divided by H·W. Differentiable in `rewards` and `next_values`,
    (H, W).
    """
    weight = discounts(done, gamma)
    end = done.clone()
    end[-1] = True
    bootstrap = end & ~terminated
    total = (weight * rewards).sum() + gamma * (weight * next_values).masked_fill(~bootstrap, 0.0).sum()
    return -total / rewards.numel()


def td_lambda_targets(
    rewards: Tensor, next_values: Tensor, terminated: Tensor, done: Tensor, gamma: float, lam: float
) -> Tensor:
    """Critic targets (H, W): Gₜ = rₜ + γ [(1 − λ) V(sₜ₊₁) + λ Gₜ₊₁], with Gₜ₊₁ = V(sₜ₊₁) at an end.

    The recursion of SHAC equation 7 (exponentially averaged k-step returns); a terminated state has value 0.
    """
    values = next_values.masked_fill(terminated, 0.0)
    targets = torch.empty_like(rewards)
    following = values[-1]
    for t in range(rewards.shape[0] - 1, -1, -1):
        mixed = (1.0 - lam) * values[t] + lam * following
        following = rewards[t] + gamma * torch.where(done[t], values[t], mixed)
        targets[t] = following
    return targets
