"""The part of an epoch that updates the actor. It never waits for the device, so that it can be recorded."""

from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from msk_ray.algorithms.shac import returns
from msk_ray.algorithms.shac.cotangent_gate import CotangentGate, CotangentRecord
from msk_ray.algorithms.shac.entropy import EntropyBonus
from msk_ray.algorithms.shac.half_batch_cosine import HalfBatchCosine
from msk_ray.algorithms.shac.optimizer import RateAdam, clip_gradients
from msk_ray.algorithms.shac.rollout import Rollout, collect
from msk_ray.config import ContactHorizon, ShacConfig
from msk_ray.envs import Env, EnvState, Resets
from msk_ray.networks import Critic, PolicyNetwork, RunningMeanStd
from msk_ray.networks.network_calls import NetworkCalls
from msk_ray.step import StepState

MAX_NONFINITE_SHARE = 0.05
"""Share of worlds whose gradient may be non-finite in an epoch before the trial stops with an error."""


class EpochInputs(NamedTuple):
    """An epoch's start state and random draws; H horizon, W worlds."""

    state: EnvState
    resets: Resets
    """States in which worlds start their next episode, H·W of them."""
    noise: Tensor
    """Standard normal noise of the actions, (H, W, A)."""

    def tensors(self) -> list[Tensor]:
        """All tensors in a fixed order."""
        return [*self.state.tensors(), *self.resets.physics, self.resets.numbers, self.noise]

    def copies(self) -> "EpochInputs":
        """A copy in new memory."""
        return EpochInputs(
            self.state.mapped(Tensor.clone),
            Resets(StepState(*(t.clone() for t in self.resets.physics)), self.resets.numbers.clone()),
            self.noise.clone(),
        )


@dataclass(frozen=True)
class RolloutGraph:
    """A rollout with its autograd graph, before the update."""

    rollout: Rollout
    state: EnvState
    """The worlds' state after the rollout."""
    gate: CotangentGate
    halves: HalfBatchCosine
    calls: NetworkCalls | None
    """Calls of the actor's network, to add up its gradients afterwards; None if autograd adds them up."""


class Observations(NamedTuple):
    """What a network saw in a rollout."""

    raw: Tensor
    """As the environment gives it, (H, W, O)."""
    normalised: Tensor
    """As the network was given it, (H, W, O)."""


@dataclass(frozen=True)
class RolloutLoss:
    """The actor's loss for a rollout, and the critic's data, which cover all worlds of the group."""

    loss: Tensor
    """The actor's loss, with its graph."""
    value: Tensor
    """Mean value of the states reached."""
    obs: Observations
    """What the actor saw."""
    critic_obs: Observations
    """What the critic saw; `obs` if that is what the actor saw."""
    targets: Tensor
    """The critic's targets, (H, W)."""

    @property
    def for_critic(self) -> tuple[Tensor, Tensor]:
        """What the critic sees, normalised, (H·W, C), and targets (H·W,)."""
        return self.critic_obs.normalised.flatten(0, 1), self.targets.flatten()


@dataclass(frozen=True)
class ActorOutcome:
    """Results of one epoch, detached, on the device, of the whole group; `state` and `terms` of this process only."""

    state: EnvState
    """Of this process's worlds."""
    obs: Tensor
    """Normalised observations of the actor, (H, W, O)."""
    critic_obs: Tensor
    """What the critic sees, normalised, (H·W, C)."""
    targets: Tensor
    """The critic's targets for them, (H·W,)."""
    rewards: Tensor
    """Shape (H, W)."""
    terms: tuple[Tensor, ...]
    """Parts of the reward in each step in this process's worlds, H tensors of shape (W, T)."""
    done: Tensor
    """Shape (H, W) bool."""
    cotangents: CotangentRecord
    metrics: dict[str, Tensor]
    """Scalars by metric name."""


class ActorUpdate:
    """Rollout, loss, backward pass and the actor's step.

    Args:
        settings: SHAC's settings.
        env: the worlds.
        network: the policy.
        critic_normalizer: statistics of what the critic sees: the network's if that is what the actor sees.
        target_critic: values of the states reached.
        return_statistics: statistics of the discounted return; None if rewards are not normalised.
        entropy: the bonus for the policy's entropy, or None.
        optimizer: the actor's.

    Attributes:
        discounted: running discounted return of each world of the group, the input of `return_statistics`.
    """

    def __init__(
        self,
        settings: ShacConfig,
        env: Env[Any],
        network: PolicyNetwork,
        critic_normalizer: RunningMeanStd,
        target_critic: Critic,
        return_statistics: RunningMeanStd | None,
        entropy: EntropyBonus | None,
        optimizer: RateAdam,
    ) -> None:
        self._settings = settings
        self._env = env
        self._network, self._actor, self._normalizer = network, network.actor, network.normalizer
        self._critic_normalizer = critic_normalizer
        self._target_critic = target_critic
        self._return_statistics = return_statistics
        self._entropy = entropy
        self._optimizer = optimizer
        self._group = env.group
        self.discounted = torch.zeros(env.nworld * env.group.size, device=env.device)

    def roll_out(self, inputs: EpochInputs) -> RolloutGraph:
        """Roll the policy out over H env steps, the length of `inputs.noise`."""
        env, c = self._env, self._settings
        # Through the mean loss, a reward of 1 in one world sends back a cotangent of norm 1/(H·W).
        bound = None if c.state_grad_clip is None else c.state_grad_clip / (len(inputs.noise) * env.nworld)
        gate = CotangentGate(bound, env.nworld, env.device)
        # Only on a CPU and for a plain network: a log σ layer would read the last hidden layer too.
        alone = self._actor.log_std_layer is None and env.device.type == "cpu"
        calls = NetworkCalls(self._actor.mean) if alone else None
        halves = HalfBatchCosine(self._actor, self._group, () if calls is None else (calls,))
        env.state = inputs.state
        env.starts.stock(inputs.resets)
        with halves.watching(), nullcontext() if calls is None else calls.recording():
            rollout = collect(
                env,
                self._network,
                self._critic_normalizer,
                inputs.noise,
                gate,
                state_bptt=c.state_bptt,
                with_neg_log_prob=self._entropy is not None,
                with_contact=isinstance(c.horizon, ContactHorizon),
            )
        return RolloutGraph(rollout, env.state.detach(), gate, halves, calls)

    def compute_loss(self, graph: RolloutGraph) -> RolloutLoss:
        """The actor's loss and the critic's targets, from the target critic's values of the states reached."""
        c, rollout, gather = self._settings, graph.rollout, self._group.gather
        loss, next_values, rewards = self._loss(rollout)
        values = next_values.detach()
        targets = returns.td_lambda_targets(rewards, values, rollout.terminated, rollout.done, c.gamma, c.lam)
        obs = critic_obs = self._observations(rollout.obs, self._normalizer)
        if self._asymmetric:
            critic_obs = self._observations(rollout.critic_obs, self._critic_normalizer)
        return RolloutLoss(loss, values.mean(), obs, critic_obs, gather(targets, dim=1))

    def _observations(self, own: Tensor, normalizer: RunningMeanStd) -> Observations:
        """Observations of the whole group, from those (H, W, O) of this process's worlds."""
        raw = self._group.gather(own, dim=1)
        return Observations(raw, normalizer.normalize(raw))

    @property
    def _asymmetric(self) -> bool:
        return self._critic_normalizer is not self._normalizer

    def update_actor(self, graph: RolloutGraph, rollout_loss: RolloutLoss) -> ActorOutcome:
        """Take the actor's step along the rollout's gradient, and update the statistics.

        The step is skipped if a larger share of worlds than `MAX_NONFINITE_SHARE` had a non-finite gradient, or if the
        policy's gradient is not finite; the metrics report it.

        `gather` and `mean` do nothing without a group. In a group, each process computes the gradient of the mean over
        its own worlds, and all have the same number of worlds.
        """
        c, rollout, gather = self._settings, graph.rollout, self._group.gather
        self._optimizer.zero_grad()
        rollout_loss.loss.backward()
        if graph.calls is not None:
            graph.calls.add_gradients()
        self._group.mean([p.grad for p in self._actor.parameters() if p.grad is not None])
        cotangents = graph.gate.record(self._group)
        limit = float("inf") if c.actor_grad_norm is None else c.actor_grad_norm
        norm = clip_gradients(list(self._actor.parameters()), limit)
        failed = (cotangents.nonfinite_share > MAX_NONFINITE_SHARE) | ~norm.isfinite()
        self._optimizer.step(skip=failed)
        self._normalizer.update(rollout_loss.obs.raw.flatten(0, 1))
        if self._asymmetric:
            self._critic_normalizer.update(rollout_loss.critic_obs.raw.flatten(0, 1))
        detached = gather(rollout.rewards.detach(), dim=1)
        means = {"train/actor_loss": rollout_loss.loss.detach(), "train/value": rollout_loss.value}
        if rollout.neg_log_prob is not None:
            means["train/entropy"] = rollout.neg_log_prob.detach().mean()
        self._group.mean(list(means.values()))
        metrics = {
            **means,
            "train/reward": detached.mean(),
            "train/diverged": gather(rollout.diverged, dim=1).sum(),
            "grad/actor_norm": norm,
            "grad/halves_cosine": graph.halves.cosine(),
            "train/std": self._actor.std(rollout_loss.obs.normalised).detach().mean(),
        }
        if rollout.contact is not None:
            weight = float(self._env.model.body_mass.sum() * -self._env.model.opt.gravity[2])
            metrics["train/contact"] = (gather(rollout.contact, dim=1) / weight).square().mean().sqrt()
        return ActorOutcome(
            graph.state,
            rollout_loss.obs.normalised,
            *rollout_loss.for_critic,
            detached,
            rollout.terms,
            gather(rollout.done, dim=1),
            cotangents,
            metrics,
        )

    def _loss(self, rollout: Rollout) -> tuple[Tensor, Tensor, Tensor]:
        """The actor's loss; and for the critic, values of the states reached and detached rewards, both (H, W)."""
        c = self._settings
        rewards = c.reward_scale * rollout.rewards
        if self._entropy is not None:
            assert rollout.neg_log_prob is not None
            rewards = rewards + self._entropy.bonus(rollout.neg_log_prob)
        std: Tensor | float = 1.0
        if self._return_statistics is not None:
            std = torch.sqrt(self._return_statistics.var + 1e-6)
            self._update_return_statistics(self._return_statistics, rewards.detach(), rollout.done)
            rewards = rewards / std
        each = self._target_critic(rollout.next_critic_obs)
        next_values = each.amin(0)
        in_loss = each.mean(0) if c.actor_value == "mean" else next_values
        # The loss is scaled back so that the learning rate means the same with and without normalised returns.
        loss = std * returns.actor_loss(rewards, in_loss, rollout.terminated, rollout.done, c.gamma)
        return loss, next_values, rewards.detach()

    def _update_return_statistics(self, statistics: RunningMeanStd, rewards: Tensor, done: Tensor) -> None:
        running, total = [], self.discounted
        rewards, done = (self._group.gather(of_worlds, dim=1) for of_worlds in (rewards, done))
        for reward, ended in zip(rewards, done, strict=True):
            total = total * self._settings.gamma + reward
            running.append(total)
            total = total.masked_fill(ended, 0.0)
        self.discounted.copy_(total)  # in place: a recorded epoch reads this memory
        statistics.update(torch.stack(running).flatten())
