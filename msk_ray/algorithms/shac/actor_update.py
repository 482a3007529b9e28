"""The part of an epoch that changes the actor. The host looks at nothing in it, so that it can be recorded."""

from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from msk_ray.algorithms.shac import returns
from msk_ray.algorithms.shac.entropy import EntropyBonus
from msk_ray.algorithms.shac.gate import CotangentGate, CotangentRecord
from msk_ray.algorithms.shac.half_batch_cosine import HalfBatchCosine
from msk_ray.algorithms.shac.optimizer import RateAdam, clip_gradients
from msk_ray.algorithms.shac.rollout import Rollout, collect
from msk_ray.config import ContactHorizon, ShacConfig
from msk_ray.envs import Env, EnvState, Resets
from msk_ray.networks import Critic, PolicyNetwork, RunningMeanStd
from msk_ray.networks.calls import Calls
from msk_ray.step import StepState

MAX_NONFINITE_SHARE = 0.05
"""Share of worlds whose gradient may be non-finite in an epoch before the trial stops with an error."""


class EpochInputs(NamedTuple):
    """What an epoch starts from and draws; H horizon, W worlds."""

    state: EnvState
    resets: Resets
    """What the worlds whose episodes end go on with, H·W of them."""
    noise: Tensor
    """Standard normal numbers of the actions, (H, W, A)."""

    def tensors(self) -> list[Tensor]:
        """All tensors in a fixed order."""
        physics, *others = self.state
        return [*physics, *others, *self.resets.physics, self.resets.numbers, self.noise]

    def copies(self) -> "EpochInputs":
        """The same in memory of its own."""
        physics, *others = self.state
        return EpochInputs(
            EnvState(StepState(*(t.clone() for t in physics)), *(t.clone() for t in others)),
            Resets(StepState(*(t.clone() for t in self.resets.physics)), self.resets.numbers.clone()),
            self.noise.clone(),
        )


@dataclass(frozen=True)
class Rolled:
    """A rollout with its graph, before anything was learned from it."""

    rollout: Rollout
    state: EnvState
    """Of the worlds after it."""
    gate: CotangentGate
    halves: HalfBatchCosine
    calls: Calls | None
    """Those of the actor's network, whose gradients are still to be added up; None if autograd does it."""


@dataclass(frozen=True)
class Judged:
    """A rollout's loss, and what the critic is to learn from it; obs and targets are of all worlds of the group."""

    loss: Tensor
    """The actor's, with its graph."""
    value: Tensor
    """Mean value of the states reached."""
    raw: Tensor
    """Observations as the environment gives them, (H, W, O)."""
    normalised: Tensor
    """The same, normalised, (H, W, O)."""
    targets: Tensor
    """The critic's targets for them, (H, W)."""

    @property
    def for_critic(self) -> tuple[Tensor, Tensor]:
        """Normalised observations (H·W, O) and targets (H·W,)."""
        return self.normalised.flatten(0, 1), self.targets.flatten()


@dataclass(frozen=True)
class ActorOutcome:
    """The results of one epoch, all detached, on the device; of all worlds of the group, but for state and terms."""

    state: EnvState
    """Of this process's worlds."""
    obs: Tensor
    """Normalised observations for the critic, (H·W, O)."""
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
        settings: those of SHAC.
        env: the worlds.
        network: the policy.
        target_critic: values of the states reached.
        return_statistics: statistics of the discounted return, or None if rewards are not divided by it.
        entropy: the bonus for the policy's entropy, or None.
        optimizer: the actor's.

    Attributes:
        discounted: the running discounted return of each world of the group, which `return_statistics` are of.
    """

    def __init__(
        self,
        settings: ShacConfig,
        env: Env[Any],
        network: PolicyNetwork,
        target_critic: Critic,
        return_statistics: RunningMeanStd | None,
        entropy: EntropyBonus | None,
        optimizer: RateAdam,
    ) -> None:
        self._settings = settings
        self._env = env
        self._actor, self._normalizer = network.actor, network.normalizer
        self._target_critic = target_critic
        self._return_statistics = return_statistics
        self._entropy = entropy
        self._optimizer = optimizer
        self._group = env.group
        self.discounted = torch.zeros(env.nworld * env.group.size, device=env.device)

    def roll(self, inputs: EpochInputs) -> Rolled:
        """Roll the policy out over as many env steps as there is noise."""
        env, c = self._env, self._settings
        # A cotangent of norm 1/(H·W) is what a reward of one in one world sends back through the mean loss.
        bound = None if c.state_grad_clip is None else c.state_grad_clip / (len(inputs.noise) * env.nworld)
        gate = CotangentGate(bound, env.nworld, env.device)
        # Recorded CUDA graphs keep autograd's order of kernels, and a layer whose output has two readers its own call.
        alone = self._actor.log_std_layer is None and env.device.type == "cpu"
        calls = Calls(self._actor.mean) if alone else None
        halves = HalfBatchCosine(self._actor, self._group, () if calls is None else (calls,))
        env.state = inputs.state
        env.stock_resets(inputs.resets)
        with halves.watching(), nullcontext() if calls is None else calls.recording():
            rollout = collect(
                env,
                self._actor,
                self._normalizer,
                inputs.noise,
                gate,
                state_bptt=c.state_bptt,
                with_neg_log_prob=self._entropy is not None,
                with_contact=isinstance(c.horizon, ContactHorizon),
            )
        return Rolled(rollout, env.state.detach(), gate, halves, calls)

    def judge(self, rolled: Rolled) -> Judged:
        """Value the states that were reached, by the target critic: the actor's loss, and the critic's targets."""
        c, rollout, gather = self._settings, rolled.rollout, self._group.gather
        loss, next_values, rewards = self._loss(rollout)
        values = next_values.detach()
        targets = returns.td_lambda_targets(rewards, values, rollout.terminated, rollout.done, c.gamma, c.lam)
        raw = gather(rollout.obs, dim=1)
        normalised = self._normalizer.normalize(raw)
        return Judged(loss, values.mean(), raw, normalised, gather(targets, dim=1))

    def learn(self, rolled: Rolled, judged: Judged) -> ActorOutcome:
        """Take the actor's step along the rollout's gradient, and update the statistics.

        The step is left out where more worlds than `MAX_NONFINITE_SHARE` had a gradient that was not finite, or the
        policy's gradient is not finite: the metrics say so.

        Outside a group `gather` and `mean` change nothing. In one, each process sent back the gradient of the mean over
        its own worlds, of which there are as many everywhere.
        """
        c, rollout, gather = self._settings, rolled.rollout, self._group.gather
        self._optimizer.zero_grad()
        judged.loss.backward()
        if rolled.calls is not None:
            rolled.calls.add_gradients()
        self._group.mean([p.grad for p in self._actor.parameters() if p.grad is not None])
        cotangents = rolled.gate.record(self._group)
        limit = float("inf") if c.actor_grad_norm is None else c.actor_grad_norm
        norm = clip_gradients(list(self._actor.parameters()), limit)
        failed = (cotangents.nonfinite_share > MAX_NONFINITE_SHARE) | ~norm.isfinite()
        self._optimizer.step(skip=failed)
        self._normalizer.update(judged.raw.flatten(0, 1))
        detached = gather(rollout.rewards.detach(), dim=1)
        means = {"train/actor_loss": judged.loss.detach(), "train/value": judged.value}
        if rollout.neg_log_prob is not None:
            means["train/entropy"] = rollout.neg_log_prob.detach().mean()
        self._group.mean(list(means.values()))
        metrics = {
            **means,
            "train/reward": detached.mean(),
            "train/diverged": gather(rollout.diverged, dim=1).sum(),
            "grad/actor_norm": norm,
            "grad/halves_cosine": rolled.halves.cosine(),
            "train/std": self._actor.std(judged.normalised).detach().mean(),
        }
        if rollout.contact is not None:
            weight = float(self._env.model.body_mass.sum() * -self._env.model.opt.gravity[2])
            metrics["train/contact"] = (gather(rollout.contact, dim=1) / weight).square().mean().sqrt()
        return ActorOutcome(
            rolled.state,
            *judged.for_critic,
            detached,
            rollout.terms,
            gather(rollout.done, dim=1),
            cotangents,
            metrics,
        )

    def _loss(self, rollout: Rollout) -> tuple[Tensor, Tensor, Tensor]:
        """The actor's loss, values of the states reached (H, W) and detached rewards, both for the critic's targets."""
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
        each = self._target_critic(rollout.next_obs)
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
