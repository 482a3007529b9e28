"""The SHAC update: one rollout, one actor step, several critic passes."""

import copy
import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from msk_ray.algorithms.base import Algorithm, Clock, EpochResult, simulation_metrics
from msk_ray.algorithms.episodes import EpisodeTracker
from msk_ray.algorithms.shac import returns
from msk_ray.algorithms.shac.critic_fit import CriticFit
from msk_ray.algorithms.shac.curriculum import ContactSchedule
from msk_ray.algorithms.shac.entropy import EntropyBonus
from msk_ray.algorithms.shac.gate import CotangentGate, Norms
from msk_ray.algorithms.shac.half_batch_cosine import HalfBatchCosine
from msk_ray.algorithms.shac.rollout import Rollout, collect
from msk_ray.algorithms.shac.schedules import adapted_horizon, horizon_at, learning_rate_at
from msk_ray.config import AdaptiveHorizon, Config, ShacConfig
from msk_ray.envs import Env
from msk_ray.errors import Failure, SimulationError
from msk_ray.networks import Actor, Critic, PolicyNetwork, RunningMeanStd


class Shac(Algorithm):
    """Actor, critic, their optimisers and the statistics they need, trained in one environment.

    Attributes:
        actor, critic, target_critic: the networks.
        normalizer: observation statistics, or None if raw observations are used.
    """

    Settings = ShacConfig
    settings: ShacConfig
    network: PolicyNetwork

    def __init__(self, config: Config, env: Env[Any]) -> None:
        init = torch.Generator().manual_seed(config.trial.seed)
        super().__init__(config, env, _network(config, env.obs_size, env.action_size, init))
        c = self.settings
        device = env.device
        self.actor, self.normalizer = self.network.actor, self.network.normalizer
        self.critic = Critic(config.critic, env.obs_size, init).to(device)
        self.target_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.return_statistics = RunningMeanStd(()).to(device) if c.normalize_return else None
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=c.actor_lr, betas=c.betas)
        self.critic_fit = CriticFit(self.critic, c.critic_lr, c.betas, c.critic_grad_norm)
        self.noise_generator = torch.Generator(device=device).manual_seed(config.trial.seed + 1)
        self.episodes = EpisodeTracker(env.nworld, device)
        self._discounted = torch.zeros(env.nworld, device=device)
        self._horizon = float(c.horizon.start) if isinstance(c.horizon, AdaptiveHorizon) else None
        self._entropy = EntropyBonus(c.entropy, env.action_size) if c.entropy is not None else None
        self._contacts = ContactSchedule(config.curriculum, env) if config.curriculum is not None else None

    @classmethod
    def policy_network(cls, config: Config, obs_size: int, action_size: int) -> PolicyNetwork:
        """An untrained actor drawn from the trial's seed, with statistics that leave observations unchanged."""
        return _network(config, obs_size, action_size, torch.Generator().manual_seed(config.trial.seed))

    @classmethod
    def policy_modules(cls, network: nn.Module) -> dict[str, nn.Module]:
        """Actor and, if observations are normalised, their statistics."""
        assert isinstance(network, PolicyNetwork)
        return network.parts()

    def modules(self) -> dict[str, nn.Module]:
        """Policy, critics and statistics."""
        found = {**self.network.parts(), "critic": self.critic, "target_critic": self.target_critic}
        return found if self.return_statistics is None else found | {"return_statistics": self.return_statistics}

    def update(self, epoch: int) -> EpochResult:
        """Train one epoch, counted from 0.

        Returns:
            Env steps, and metrics with seconds spent in rollout, backward and critic.

        Raises:
            SimulationError: too many worlds had a non-finite gradient, the policy's gradient is not finite, or the
                physics ran out of buffer space.
        """
        c = self.settings
        horizon = self._horizon_now(epoch)
        epochs = self.config.trial.epochs
        actor_lr = learning_rate_at(c.actor_lr, c.final_lr, c.lr_schedule, epoch, epochs)
        critic_lr = learning_rate_at(c.critic_lr, c.final_lr, c.lr_schedule, epoch, epochs)
        for group in self.actor_optimizer.param_groups:
            group["lr"] = actor_lr
        self.critic_fit.set_learning_rate(critic_lr)
        clock = Clock(self.env.device)

        # A cotangent of norm 1/(H·W) is what a reward of one in one world sends back through the mean loss.
        unit = 1.0 / (horizon * self.env.nworld)
        gate = CotangentGate(
            None if c.state_grad_clip is None else c.state_grad_clip * unit, self.env.nworld, self.env.device
        )
        halves = HalfBatchCosine(self.actor)
        with halves.watching():
            rollout, loss, next_values, scaled_rewards = self._forward(horizon, gate)
        rollout_s = clock.lap()

        self.actor_optimizer.zero_grad()
        loss.backward()
        cotangents = gate.statistics(unit)
        gradient_norm = self._step_actor(float(cotangents.nonfinite_share))
        backward_s = clock.lap()

        critic_loss = self._train_critic(rollout, next_values.detach(), scaled_rewards)
        if self.normalizer is not None:
            self.normalizer.update(rollout.obs.flatten(0, 1))
        critic_s = clock.lap()

        reward = rollout.rewards.detach().mean()
        metrics = {
            "train/actor_loss": loss.detach(),
            "train/critic_loss": critic_loss,
            "train/reward": reward,
            "train/value": next_values.detach().mean(),
            "train/diverged": rollout.diverged.sum(),
            "grad/actor_norm": gradient_norm,
            "grad/halves_cosine": halves.cosine(),
            **cotangents.metrics(),
            **self.episodes.update(rollout.rewards.detach(), rollout.done),
        }
        if self.actor.log_std is not None:
            metrics["train/std"] = self.actor.log_std.detach().exp().mean()
        numbers = {name: float(value) for name, value in metrics.items()}
        numbers |= self._adapt(rollout, float(reward), cotangents.norms)
        numbers |= {
            "train/horizon": float(horizon),
            "train/actor_lr": actor_lr,
            "time/rollout_s": rollout_s,
            "time/backward_s": backward_s,
            "time/critic_s": critic_s,
            **simulation_metrics(self.env),
        }
        return EpochResult(horizon * self.env.nworld, numbers)

    def state_dict(self) -> dict[str, Any]:
        """Everything that a later `load_state_dict` needs to continue exactly, including the environment's state."""
        return {
            **super().state_dict(),
            "actor_optimizer": self.actor_optimizer.state_dict(),
            "critic_optimizer": self.critic_fit.optimizer.state_dict(),
            "noise_generator": self.noise_generator.get_state(),
            "episodes": self.episodes.state_dict(),
            "discounted": self._discounted.clone(),
            "horizon": self._horizon,
            "entropy_coefficient": None if self._entropy is None else self._entropy.coefficient,
            "curriculum": None if self._contacts is None else self._contacts.progress,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        super().load_state_dict(state)
        self.actor_optimizer.load_state_dict(state["actor_optimizer"])
        self.critic_fit.load_state_dict(state["critic_optimizer"])
        # Generator states are host tensors on every device.
        self.noise_generator.set_state(state["noise_generator"].cpu())
        self.episodes.load_state_dict(state["episodes"])
        self._discounted = state["discounted"]
        self._horizon = state.get("horizon")
        if self._entropy is not None:
            self._entropy.coefficient = state["entropy_coefficient"]
        if self._contacts is not None:
            self._contacts.set_progress(state["curriculum"])

    def _horizon_now(self, epoch: int) -> int:
        configured = self.settings.horizon
        if isinstance(configured, AdaptiveHorizon):
            assert self._horizon is not None
            return round(self._horizon)
        return horizon_at(configured, epoch)

    def _adapt(self, rollout: Rollout, reward: float, norms: Norms | None) -> dict[str, float]:
        """Advance horizon, entropy bonus and contacts after an epoch.

        Args:
            rollout: the epoch's rollout.
            reward: its mean reward per env step.
            norms: norms of its state cotangents.

        Returns:
            Their values before, by metric name.
        """
        stood: dict[str, float] = {}
        if isinstance(self.settings.horizon, AdaptiveHorizon):
            assert self._horizon is not None
            p90 = math.nan if norms is None else float(norms.p90)
            self._horizon = adapted_horizon(self.settings.horizon, self._horizon, p90)
        if self._entropy is not None:
            assert rollout.neg_log_prob is not None
            entropy = float(rollout.neg_log_prob.detach().mean())
            stood |= {"train/entropy": entropy, "train/entropy_coefficient": self._entropy.coefficient}
            self._entropy.adapt(entropy)
        if self._contacts is not None:
            stood["train/curriculum"] = self._contacts.progress
            self._contacts.advance(reward)
        return stood

    def _forward(self, horizon: int, gate: CotangentGate) -> tuple[Rollout, Tensor, Tensor, Tensor]:
        """Rollout, actor loss, attached values of the states reached (H, W), and detached rewards for the critic."""
        c = self.settings
        noise = torch.randn(
            (horizon, self.env.nworld, self.env.action_size), generator=self.noise_generator, device=self.env.device
        )
        rollout = collect(
            self.env,
            self.actor,
            self.normalizer,
            noise,
            gate,
            state_bptt=c.state_bptt,
            with_neg_log_prob=self._entropy is not None,
        )
        rewards = c.reward_scale * rollout.rewards
        if self._entropy is not None:
            assert rollout.neg_log_prob is not None
            rewards = rewards + self._entropy.coefficient * rollout.neg_log_prob
        std: Tensor | float = 1.0
        if self.return_statistics is not None:
            std = torch.sqrt(self.return_statistics.var + 1e-6)
            self._update_return_statistics(rewards.detach(), rollout.done)
            rewards = rewards / std
        next_values = self.target_critic.value(rollout.next_obs)
        # The loss is scaled back so that the learning rate means the same with and without normalised returns.
        loss = std * returns.actor_loss(rewards, next_values, rollout.terminated, rollout.done, c.gamma)
        return rollout, loss, next_values, rewards.detach()

    def _update_return_statistics(self, rewards: Tensor, done: Tensor) -> None:
        assert self.return_statistics is not None
        running = []
        for reward, ended in zip(rewards, done, strict=True):
            self._discounted = self._discounted * self.settings.gamma + reward
            running.append(self._discounted)
            self._discounted = torch.where(ended, 0.0, self._discounted)
        self.return_statistics.update(torch.stack(running).flatten())

    def _step_actor(self, lost: float) -> Tensor:
        """Take the actor's step; `lost` is the share of worlds without a finite gradient.

        Returns:
            The gradient's norm before clipping.
        """
        limit = self.settings.actor_grad_norm
        norm = nn.utils.clip_grad_norm_(self.actor.parameters(), float("inf") if limit is None else limit)
        allowed = self.settings.max_nonfinite_share
        if lost > allowed:
            raise SimulationError(
                f"nonfinite_gradient: the state cotangent of {lost:.1%} of the worlds was not finite "
                f"(shac.max_nonfinite_share allows {allowed:.1%}); shorten shac.horizon, set shac.state_grad_clip or "
                "soften the contacts",
                Failure.NONFINITE,
            )
        if not bool(norm.isfinite()):
            raise SimulationError(
                "nonfinite_gradient: the policy gradient is not finite; lower shac.actor_lr", Failure.NONFINITE
            )
        self.actor_optimizer.step()
        return norm

    def _train_critic(self, rollout: Rollout, next_values: Tensor, rewards: Tensor) -> Tensor:
        """Fit the critic to its targets, move the target critic, and return the last pass's mean loss."""
        c = self.settings
        if c.critic_method == "td-lambda":
            targets = returns.td_lambda_targets(rewards, next_values, rollout.terminated, rollout.done, c.gamma, c.lam)
        else:
            targets = returns.one_step_targets(rewards, next_values, rollout.terminated, c.gamma)
        obs = rollout.obs if self.normalizer is None else self.normalizer.normalize(rollout.obs)
        obs, targets = obs.flatten(0, 1), targets.flatten()
        loss = self.critic_fit.run(obs, targets, c.critic_iterations, c.critic_batches, self.noise_generator)
        with torch.no_grad():
            for target, source in zip(self.target_critic.parameters(), self.critic.parameters(), strict=True):
                target.lerp_(source, 1.0 - c.target_critic_alpha)
        return loss


def _network(config: Config, obs_size: int, action_size: int, generator: torch.Generator) -> PolicyNetwork:
    settings = config.algorithm_settings
    assert isinstance(settings, ShacConfig)
    return PolicyNetwork(
        Actor(config.actor, obs_size, action_size, generator),
        RunningMeanStd((obs_size,)) if settings.normalize_obs else None,
    )
