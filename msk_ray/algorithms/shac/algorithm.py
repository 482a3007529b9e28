"""The SHAC update: one rollout, one actor step, several critic passes."""

import copy
import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from msk_ray.algorithms.base import Algorithm, EpochResult, simulation_metrics
from msk_ray.algorithms.episode_tracker import EpisodeTracker
from msk_ray.algorithms.nonfinite import nonfinite_observation, nonfinite_reward
from msk_ray.algorithms.shac.actor_update import MAX_NONFINITE_SHARE, ActorOutcome, ActorUpdate, EpochInputs
from msk_ray.algorithms.shac.critic_fit import CriticFit
from msk_ray.algorithms.shac.curriculum import ContactSchedule
from msk_ray.algorithms.shac.entropy import EntropyBonus
from msk_ray.algorithms.shac.horizon import RolloutLength
from msk_ray.algorithms.shac.optimizer import RateAdam
from msk_ray.algorithms.shac.recorded_runner import UNRECORDED, RecordedRunner
from msk_ray.algorithms.shac.runner import EagerRunner
from msk_ray.algorithms.shac.schedules import learning_rate_at
from msk_ray.config import Config, ShacConfig
from msk_ray.envs import Env
from msk_ray.errors import Failure, SimulationError
from msk_ray.networks import Actor, Critic, PolicyNetwork, RunningMeanStd

_BETAS = (0.7, 0.95)
"""Adam's moment decays, as published with SHAC."""


class Shac(Algorithm):
    """Actor, critic, their optimisers and the statistics they need, trained in one environment.

    Attributes:
        actor, critic, target_critic: the networks.
        normalizer: observation statistics.
        critic_normalizer: those of what the critic sees; `normalizer` if that is what the actor sees.
    """

    Settings = ShacConfig
    settings: ShacConfig
    counts_episodes = True
    network: PolicyNetwork

    def __init__(self, config: Config, env: Env[Any]) -> None:
        init = torch.Generator().manual_seed(config.trial.seed)
        super().__init__(config, env, _network(config, env.obs_size, env.action_size, init))
        c = self.settings
        device = env.device
        self.actor, self.normalizer = self.network.actor, self.network.normalizer
        self.critic_normalizer = self.normalizer
        if env.asymmetric:
            self.critic_normalizer = RunningMeanStd((env.critic_size,)).to(device)
        self.critic = Critic(config.critic, env.critic_size, init).to(device)
        self.target_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.return_statistics = RunningMeanStd(()).to(device) if c.normalize_return else None
        self.actor_optimizer = RateAdam(self.actor.parameters(), c.actor_lr, _BETAS, c.weight_decay)
        self.critic_fit = CriticFit(
            self.critic,
            c.critic_lr,
            _BETAS,
            c.critic_grad_norm,
            weight_decay=c.weight_decay,
            tolerance=c.critic_tolerance,
            group=env.group,
        )
        self.generator = torch.Generator(device=device).manual_seed(config.trial.seed + 1)
        self._worlds = env.nworld * env.group.size
        self.episodes = EpisodeTracker(self._worlds, device)
        self._horizon = RolloutLength(c.horizon)
        self._entropy = EntropyBonus(c.entropy, env.action_size, device) if c.entropy is not None else None
        self._contacts = ContactSchedule(config.curriculum, env) if config.curriculum is not None else None
        self._actor_update = ActorUpdate(
            c,
            env,
            self.network,
            self.critic_normalizer,
            self.target_critic,
            self.return_statistics,
            self._entropy,
            self.actor_optimizer,
        )
        self._runner = (
            RecordedRunner(self._actor_update, self, env)
            if config.execution.capture == "auto" and device.type == "cuda"
            else EagerRunner(self._actor_update, self, env)
        )

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
        modules = {**self.network.parts(), "critic": self.critic, "target_critic": self.target_critic}
        if self.critic_normalizer is not self.normalizer:
            modules["critic_normalizer"] = self.critic_normalizer
        return modules if self.return_statistics is None else modules | {"return_statistics": self.return_statistics}

    def start_from(self, modules: Mapping[str, Any]) -> list[str]:
        """As for every algorithm; a critic that saw what its actor saw goes on with that actor's statistics."""
        if "critic" in modules and "critic_normalizer" not in modules:
            modules = {**modules, "critic_normalizer": modules["normalizer"]}
        return super().start_from(modules)

    def update(self, epoch: int) -> EpochResult:
        """Train one epoch, counted from 0.

        Returns:
            Env steps, and metrics with seconds spent in rollout, backward and critic. In recorded epochs, the critic's
            loss and time are from the previous epoch, because this epoch's fit is still running.

        Raises:
            SimulationError: an observation or a reward is not finite, too many worlds had a gradient that is not, the
                policy's gradient is not, or the physics ran out of buffer space.
        """
        c = self.settings
        horizon = self._horizon.at(epoch)
        actor_lr = self._rate(c.actor_lr, epoch)
        self.actor_optimizer.set_rate(actor_lr)
        inputs = self._draw(horizon, epoch)
        self._note_draws(inputs)
        outcome = self._runner.run(inputs, self._rate(c.critic_lr, epoch))
        self._note_outcome(outcome)
        seconds = self._runner.seconds()
        self.env.sim.settle()
        cotangents = outcome.cotangents.statistics(1.0 / (horizon * self.env.nworld))
        episodes = self.episodes.update(outcome.rewards, outcome.done)
        metrics = {**outcome.metrics, **cotangents.metrics(), **episodes}
        if self._runner.last_loss is not None:
            metrics["train/critic_loss"] = self._runner.last_loss
        # One transfer, so that the host waits once and not for each number.
        values = torch.stack([value.float() for value in metrics.values()]).tolist()
        numbers = dict(zip(metrics, values, strict=True))
        self._check_finite(outcome, numbers, epoch)
        self._horizon.follow(cotangents.norms, numbers.get("train/contact"))
        numbers |= self._adapt(numbers.get("train/entropy"))
        numbers |= {
            **({} if c.exploration is None else {"train/exploration": c.exploration.at(epoch)}),
            "train/horizon": float(horizon),
            "train/actor_lr": actor_lr,
            "train/recorded": float(self._runner.recorded),
            **({} if self._runner.refusal is None else {"train/unrecordable": 1.0}),
            **{f"time/{part}_s": value for part, value in seconds.items()},
            **simulation_metrics(self.env),
        }
        self._runner.adapt()
        return EpochResult(horizon * self._worlds, numbers, round(numbers["train/episodes"]))

    def _note_draws(self, inputs: EpochInputs) -> None:
        if self.digest_log is not None:
            self.digest_log.note("draws", {"noise": inputs.noise, **inputs.state.physics._asdict()})

    def _note_outcome(self, outcome: ActorOutcome) -> None:
        if self.digest_log is not None:
            rollout = {"observations": outcome.obs, "rewards": outcome.rewards, "ends of episodes": outcome.done}
            self.digest_log.note("rollout", {**rollout, **outcome.state.physics._asdict()})
            self.digest_log.note("values", {"targets of the critic": outcome.targets})
            self.digest_log.note("gradients", {"policy": torch.cat([p.flatten() for p in self.actor.parameters()])})

    def remarks(self) -> list[str]:
        """Why epochs are not recorded, although they should be."""
        return [] if self._runner.refusal is None else [f"{UNRECORDED}: {self._runner.refusal}"]

    def note_state(self) -> None:
        """Record digests of worlds and modules, once the critic's fit has ended, if there is a `digest_log`."""
        self._runner.join()
        super().note_state()

    def parameter_hash(self) -> str:
        """Digest of policy, critics and statistics, once the critic's fit has ended."""
        self._runner.join()
        return super().parameter_hash()

    def state_dict(self) -> dict[str, Any]:
        """Everything that a later `load_state_dict` needs to continue exactly, including the environment's state."""
        self._runner.join()
        return {
            **super().state_dict(),
            "actor_optimizer": self.actor_optimizer.state_dict(),
            "critic_optimizer": self.critic_fit.optimizer.state_dict(),
            "critic_loss": self._runner.newest_loss,
            "noise_generator": self.generator.get_state(),
            "episodes": self.episodes.state_dict(),
            "discounted": self._actor_update.discounted.clone(),
            **self._horizon.state_dict(),
            "entropy_coefficient": None if self._entropy is None else self._entropy.coefficient,
            "curriculum": None if self._contacts is None else self._contacts.progress,
            **({"iterations": self.env.sim.batch.unrolled_iterations} if self.env.sim.batch.ordered else {}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._runner.join()
        super().load_state_dict(state)
        self.actor_optimizer.load_state_dict(state["actor_optimizer"])
        self.critic_fit.optimizer.load_state_dict(state["critic_optimizer"])
        self._runner.resume(state.get("critic_loss"))
        # Generator states are host tensors on every device.
        self.generator.set_state(state["noise_generator"].cpu())
        self.episodes.load_state_dict(state["episodes"])
        self._actor_update.discounted.copy_(state["discounted"])
        self._horizon.load_state_dict(state)
        if self._entropy is not None:
            self._entropy.coefficient = state["entropy_coefficient"]
        if self._contacts is not None:
            self._contacts.set_progress(state["curriculum"])
        if self.env.sim.batch.ordered:
            self.env.sim.batch.unrolled_iterations = state["iterations"]

    def _rate(self, rate: float, epoch: int) -> float:
        """The learning rate at an epoch, if it was `rate` at the first."""
        c = self.settings
        return learning_rate_at(rate, c.final_lr, c.lr_schedule, epoch, self.config.trial.epochs)

    def _draw(self, horizon: int, epoch: int) -> EpochInputs:
        env, c = self.env, self.settings
        noise = torch.randn((horizon, self._worlds, env.action_size), generator=self.generator, device=env.device)
        if c.exploration is not None:
            noise *= c.exploration.at(epoch)
        return EpochInputs(env.state.detach(), env.starts.draw_steps(horizon, env.group), env.group.own(noise, dim=1))

    def _adapt(self, entropy: float | None) -> dict[str, float]:
        """Advance entropy bonus and contacts after an epoch.

        Args:
            entropy: the epoch's mean entropy of the policy [nat], if there is a bonus for it.

        Returns:
            Their values before, by metric name.
        """
        stood: dict[str, float] = {}
        if self._entropy is not None:
            assert entropy is not None
            stood["train/entropy_coefficient"] = self._entropy.coefficient
            self._entropy.adapt(entropy)
        if self._contacts is not None:
            stood["train/curriculum"] = self._contacts.progress
            self._contacts.advance()
        return stood

    def _check_finite(self, outcome: ActorOutcome, numbers: Mapping[str, float], epoch: int) -> None:
        """Raise SimulationError for a non-finite reward, or a non-finite gradient for which the step was skipped.

        Args:
            outcome: the epoch's results.
            numbers: its metrics, by name.
            epoch: counted from 0.
        """
        lost, norm = numbers["grad/nonfinite_share"], numbers["grad/actor_norm"]
        allowed = MAX_NONFINITE_SHARE
        rewarded = math.isfinite(numbers["train/reward"])
        if rewarded and lost <= allowed and math.isfinite(norm):
            return
        if (error := nonfinite_observation(self.env, outcome.obs, epoch)) is not None:
            raise error
        seen = outcome.critic_obs.unflatten(0, (-1, self._worlds))
        if (error := nonfinite_observation(self.env, seen, epoch, method="observe_critic")) is not None:
            raise error
        if not rewarded:
            raise nonfinite_reward(self.env, outcome.terms, epoch)
        if lost > allowed:
            raise SimulationError(
                f"nonfinite_gradient: the state cotangent of {lost:.1%} of the worlds was not finite "
                f"({allowed:.0%} may be); shorten shac.horizon, set shac.state_grad_clip or "
                "soften the contacts; or look in observe and reward_terms for a root or norm at 0",
                Failure.NONFINITE,
            )
        raise SimulationError(
            "nonfinite_gradient: the policy gradient is not finite; lower shac.actor_lr", Failure.NONFINITE
        )

    def prepare_fit(self, rows: int, rate: float) -> Tensor:
        """Set the critic's learning rate, and draw a random order of the rows for each pass of a fit, (passes, rows).

        The previous fit must have ended, because it reads the rate.
        """
        self.critic_fit.optimizer.set_rate(rate)
        return self.critic_fit.draw_orders(rows, self.settings.critic_iterations, self.generator)

    def fit_critic(self, obs: Tensor, targets: Tensor, orders: Tensor) -> Tensor:
        """Fit the critic, and return the last pass's mean loss."""
        return self.critic_fit.run(obs, targets, orders, self.settings.critic_batches)

    @torch.no_grad()
    def move_target(self) -> None:
        """Let the target critic follow the critic."""
        for target, source in zip(self.target_critic.parameters(), self.critic.parameters(), strict=True):
            target.lerp_(source, 1.0 - self.settings.target_critic_alpha)


def _network(config: Config, obs_size: int, action_size: int, generator: torch.Generator) -> PolicyNetwork:
    return PolicyNetwork(Actor(config.actor, obs_size, action_size, generator), RunningMeanStd((obs_size,)))
