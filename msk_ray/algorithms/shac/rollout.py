"""One rollout of the current policy over the horizon, with its autograd graph."""

from dataclasses import dataclass

import torch
from torch import Tensor

from msk_ray.algorithms.shac.cotangent_gate import CotangentGate
from msk_ray.envs import Env
from msk_ray.networks import PolicyNetwork, RunningMeanStd


@dataclass
class Rollout:
    """H steps of W worlds."""

    obs: Tensor
    """Raw observations from which the actions were chosen, detached, shape (H, W, O)."""
    critic_obs: Tensor
    """What the critic sees of the same states, raw, detached, shape (H, W, C); `obs` if it sees what the actor sees."""
    next_critic_obs: Tensor
    """What it sees of the states reached, before any reset, normalised, attached, shape (H, W, C)."""
    rewards: Tensor
    """Attached, shape (H, W)."""
    terms: tuple[Tensor, ...]
    """Parts of the reward in each step, detached, H tensors of shape (W, T)."""
    terminated: Tensor
    """Shape (H, W) bool."""
    done: Tensor
    """Terminated or truncated, shape (H, W) bool."""
    diverged: Tensor
    """Shape (H, W) bool."""
    neg_log_prob: Tensor | None
    """−log π of the actions taken [nat], attached, shape (H, W); None if not requested."""
    contact: Tensor | None
    """Summed magnitude of the contact forces at the end of each step [N], shape (H, W); None if not requested."""


def collect(
    env: Env,
    network: PolicyNetwork,
    critic_normalizer: RunningMeanStd,
    noise: Tensor,
    gate: CotangentGate,
    *,
    state_bptt: bool,
    with_neg_log_prob: bool = False,
    with_contact: bool = False,
) -> Rollout:
    """Roll a policy out for H steps of noise (H, W, A), from the worlds' current state. Resets must be in stock.

    `critic_normalizer` is of what the critic sees: the network's if that is what the actor sees.

    The graph starts at the first state. If `state_bptt` is false, the state is detached at every step, so that an
    action gets a gradient from its own step only. The normalizers are held fixed during the rollout.
    """
    env.state = env.state.detach()
    raw, critic_raw, reached, rewards, terms, terminated, done, diverged = [], [], [], [], [], [], [], []
    neg_log_probs, contacts = [], []
    actor, normalize = network.actor, network.normalizer.fixed()
    normalize_critic = normalize if critic_normalizer is network.normalizer else critic_normalizer.fixed()
    for step_noise in noise:
        env.state = gate(env.state) if state_bptt else env.state.detach()
        obs = env.observation()
        if env.asymmetric:
            critic_raw.append(env.critic_observation().detach())
        if with_neg_log_prob:
            action, neg_log_prob = actor.sample(normalize(obs), step_noise)
            neg_log_probs.append(neg_log_prob)
        else:
            action = actor(normalize(obs), step_noise)
        transition = env.step(gate.screen(action))
        if with_contact:
            # Read before the next step overwrites it. Halved, as each contact acts on two geoms; 0 in diverged worlds.
            force = 0.5 * env.sim.contact_forces().norm(dim=-1).sum(-1)
            contacts.append(force.masked_fill(transition.diverged, 0.0))
        raw.append(obs.detach())
        reached.append(env.critic_observation_of(transition.reached) if env.asymmetric else transition.obs)
        rewards.append(transition.reward)
        terms.append(transition.terms)
        terminated.append(transition.terminated)
        done.append(transition.terminated | transition.truncated)
        diverged.append(transition.diverged)
    observations = torch.stack(raw)
    return Rollout(
        observations,
        torch.stack(critic_raw) if critic_raw else observations,
        normalize_critic(torch.stack(reached)),
        torch.stack(rewards),
        tuple(terms),
        torch.stack(terminated),
        torch.stack(done),
        torch.stack(diverged),
        torch.stack(neg_log_probs) if neg_log_probs else None,
        torch.stack(contacts) if contacts else None,
    )
