"""PPO: one rollout without gradients, then several passes of minibatches, with networks and losses of rsl-rl-lib."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from msk_ray.algorithms.base import Algorithm, Clock, EpochResult, simulation_metrics
from msk_ray.algorithms.episode_tracker import EpisodeTracker
from msk_ray.algorithms.nonfinite import nonfinite_observation, nonfinite_reward
from msk_ray.config import Config, NetworkConfig, PpoConfig
from msk_ray.envs import Env
from msk_ray.errors import Failure, SimulationError

if TYPE_CHECKING:
    from rsl_rl.models import MLPModel

_GROUP, _CRITIC_GROUP = "obs", "critic_obs"
"""rsl_rl's observations are named groups: one for both networks, or one for each if the critic sees something else."""
_GROUPS = {_GROUP: "observe", _CRITIC_GROUP: "observe_critic"}
"""The environment's method that gives each."""
_ACTIVATIONS = {"silu": "swish"}
"""rsl_rl's names of activations that differ from ours."""


class GaussianPolicy(nn.Module):
    """Raw observations (..., O) to the mean (..., A) of rsl_rl's Gaussian policy, clamped to [-1, 1]."""

    def __init__(self, actor: MLPModel) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, obs: Tensor) -> Tensor:
        mean: Tensor = self.actor({_GROUP: obs})
        return mean.clamp(-1.0, 1.0)


class Ppo(Algorithm):
    """Actor, critic and optimiser of rsl_rl's PPO, trained in one environment, with actions clamped to [-1, 1].

    Noise and minibatches are drawn from torch's global generators.
    """

    Settings = PpoConfig
    counts_episodes = True
    settings: PpoConfig
    network: GaussianPolicy

    def __init__(self, config: Config, env: Env[Any]) -> None:
        from rsl_rl.algorithms import PPO
        from rsl_rl.storage import RolloutStorage

        super().__init__(config, env)
        c, device = self.settings, str(env.device)
        group = _CRITIC_GROUP if env.asymmetric else _GROUP
        critic = _network(config.critic, "critic", group, env.critic_size, 1).to(env.device)
        storage = RolloutStorage("rl", env.nworld, c.steps, self._observe(), [env.action_size], device)
        self.ppo = PPO(
            self.network.actor,
            critic,
            storage,
            num_learning_epochs=c.passes,
            num_mini_batches=c.minibatches,
            clip_param=c.clip,
            use_clipped_value_loss=True,
            gamma=c.gamma,
            lam=c.lam,
            learning_rate=c.lr,
            schedule="adaptive" if c.lr_schedule == "adaptive" else "fixed",
            desired_kl=c.desired_kl,
            value_loss_coef=1.0,
            entropy_coef=c.entropy_coefficient,
            max_grad_norm=1.0,
            device=device,
        )
        self.ppo.train_mode()
        self.episodes = EpisodeTracker(env.nworld, env.device)

    @classmethod
    def policy_network(cls, config: Config, obs_size: int, action_size: int) -> GaussianPolicy:
        """A policy with weights drawn from torch's global generator, and empty observation statistics."""
        noise = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "log"}
        return GaussianPolicy(_network(config.actor, "actor", _GROUP, obs_size, action_size, noise))

    @classmethod
    def policy_modules(cls, network: nn.Module) -> dict[str, nn.Module]:
        """The actor, including its observation statistics."""
        assert isinstance(network, GaussianPolicy)
        return {"actor": network.actor}

    def modules(self) -> dict[str, nn.Module]:
        """Actor and critic."""
        return {"actor": self.network.actor, "critic": self.ppo.critic}

    def update(self, epoch: int) -> EpochResult:
        """Train one epoch, counted from 0.

        Returns:
            Env steps, and metrics with seconds spent in the rollout and in learning from it.

        Raises:
            SimulationError: an observation, a reward, a loss or a weight is not finite, or the physics ran out of
                buffer space.
        """
        clock = Clock(self.env.device)
        try:
            rewards, done, diverged = self._collect(epoch)
            clock.mark("rollout")
            if self.digest_log is not None:
                storage = self.ppo.storage
                self.digest_log.note(
                    "rollout", {**storage.observations, "rewards": rewards, "actions": storage.actions}
                )
            values = self.ppo.storage.values.mean()
            losses = self.ppo.update()
        except (RuntimeError, ValueError):
            # Torch raises this for a mean or standard deviation that is NaN, for example.
            self._check("weights", self._weights())
            if (fault := self._fault(self._observe()[None], epoch, self.ppo.storage.step)) is not None:
                raise fault from None
            raise
        self._check("losses and weights", [*losses.values(), *self._weights()])
        clock.mark("learning")
        metrics = {
            "train/actor_loss": losses["surrogate"],
            "train/critic_loss": losses["value"],
            "train/entropy": losses["entropy"],
            "train/reward": rewards.mean(),
            "train/value": values,
            "train/diverged": diverged,
            "train/std": self.ppo.actor.output_std.detach().mean(),
            **self.episodes.update(rewards, done),
        }
        numbers = {name: float(value) for name, value in metrics.items()}
        numbers |= {
            "train/actor_lr": self.ppo.learning_rate,
            **{f"time/{part}_s": seconds for part, seconds in clock.seconds().items()},
            **simulation_metrics(self.env),
        }
        return EpochResult(self.settings.steps * self.env.nworld, numbers, round(numbers["train/episodes"]))

    def state_dict(self) -> dict[str, Any]:
        """Everything that a later `load_state_dict` needs to continue exactly, including the environment's state."""
        return {
            **super().state_dict(),
            "optimizer": self.ppo.optimizer.state_dict(),
            "learning_rate": self.ppo.learning_rate,
            "episodes": self.episodes.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        super().load_state_dict(state)
        self.ppo.optimizer.load_state_dict(state["optimizer"])
        self.ppo.learning_rate = state["learning_rate"]
        self.episodes.load_state_dict(state["episodes"])

    @torch.no_grad()
    def _collect(self, epoch: int) -> tuple[Tensor, Tensor, Tensor]:
        """Fill rsl_rl's storage; returns rewards (H, W), ends of episodes (H, W) bool, and how many worlds diverged."""
        env, ppo = self.env, self.ppo
        env.state = env.state.detach()
        env.starts.stock(env.starts.draw_steps(self.settings.steps, env.group))
        rewards, terms, ends = [], [], []
        diverged = torch.zeros((), dtype=torch.int64, device=env.device)
        obs = self._observe()
        for _ in range(self.settings.steps):
            transition = env.step(ppo.act(obs).clamp(-1.0, 1.0))
            done = transition.terminated | transition.truncated
            obs = self._observe()
            # A time limit does not end the task: rsl_rl adds the value of the state in which the episode was cut.
            ppo.process_env_step(obs, transition.reward, done, {"time_outs": transition.truncated})
            rewards.append(transition.reward)
            terms.append(transition.terms)
            ends.append(done)
            diverged += transition.diverged.sum()
        if (fault := self._fault(ppo.storage.observations, epoch)) is not None:
            raise fault
        if not bool(torch.stack(rewards).isfinite().all()):
            raise nonfinite_reward(env, terms, epoch)
        ppo.compute_returns(obs)
        return torch.stack(rewards), torch.stack(ends), diverged

    def _weights(self) -> list[nn.Parameter]:
        return [*self.ppo.actor.parameters(), *self.ppo.critic.parameters()]

    def _observe(self) -> Any:
        from tensordict import TensorDict

        env = self.env
        seen = {_GROUP: env.observation()}
        if env.asymmetric:
            seen[_CRITIC_GROUP] = env.critic_observation()
        return TensorDict(seen, batch_size=[env.nworld])

    def _fault(self, observations: Mapping[str, Tensor], epoch: int, done: int = 0) -> SimulationError | None:
        """As `nonfinite_observation`, for all groups of observations."""
        seen = observations.items()
        faults = (nonfinite_observation(self.env, values, epoch, done, _GROUPS[group]) for group, values in seen)
        return next(filter(None, faults), None)

    def _check(self, what: str, values: Iterable[Tensor | float]) -> None:
        finite = [torch.as_tensor(value, device=self.env.device).isfinite().all() for value in values]
        if not bool(torch.stack(finite).all()):
            raise SimulationError(
                f"nonfinite_update: PPO's {what} are not finite; lower ppo.lr or ppo.desired_kl",
                Failure.NONFINITE,
            )


def _network(
    config: NetworkConfig,
    name: str,
    group: str,
    inputs: int,
    outputs: int,
    noise: dict[str, Any] | None = None,
) -> MLPModel:
    """rsl_rl's multilayer perceptron, with torch's default initial weights of linear layers and observations normalised
    by their running mean and variance."""
    from rsl_rl.models import MLPModel

    return MLPModel(
        {group: torch.zeros(1, inputs)},
        {name: [group]},
        name,
        outputs,
        hidden_dims=list(config.hidden),
        activation=_ACTIVATIONS.get(config.activation, config.activation),
        obs_normalization=True,
        distribution_cfg=noise,
    )
