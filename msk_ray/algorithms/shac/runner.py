"""Runs an epoch's work operation by operation."""

from typing import Any, Protocol

from torch import Tensor

from msk_ray.algorithms.base import Clock
from msk_ray.algorithms.shac.actor_update import ActorOutcome, ActorUpdate, EpochInputs
from msk_ray.envs import Env


class CriticWork(Protocol):
    """The critic as a runner uses it."""

    def prepare_fit(self, rows: int, rate: float) -> Tensor:
        """Set the learning rate of the next fit, and draw its orders of the rows, (passes, rows)."""

    def fit_critic(self, obs: Tensor, targets: Tensor, orders: Tensor) -> Tensor:
        """Fit the critic to what it saw (N, C) and targets (N,) in these orders, and return the loss."""

    def move_target(self) -> None:
        """Move the target critic towards the fitted critic."""


class EagerRunner:
    """Runs an epoch's work operation by operation.

    Attributes:
        recorded: whether the last epoch was replayed from a recording.
        last_loss: the critic's newest known loss; None before the first fit.
        refusal: why epochs are no longer recorded, although they should be; None otherwise.
    """

    recorded = False
    refusal: str | None = None

    def __init__(self, actor: ActorUpdate, critic: CriticWork, env: Env[Any]) -> None:
        self._actor = actor
        self._critic = critic
        self._env = env
        self._device = env.device
        self._clock = Clock(env.device)
        self.last_loss: Tensor | None = None

    @property
    def newest_loss(self) -> Tensor | None:
        """The critic's loss in the newest fit, once that has ended; None before the first."""
        return self.last_loss

    def resume(self, loss: Tensor | None) -> None:
        """Continue after a fit with this loss."""
        self.last_loss = loss

    def run(self, inputs: EpochInputs, critic_rate: float) -> ActorOutcome:
        """One epoch: the rollout, the actor's step along its gradient, and the fit of the critic at this rate."""
        outcome = self._run_actor(inputs)
        self.last_loss = self._critic.fit_critic(
            outcome.critic_obs, outcome.targets, self._critic.prepare_fit(outcome.targets.numel(), critic_rate)
        )
        self._critic.move_target()
        self._clock.mark("critic")
        return outcome

    def _run_actor(self, inputs: EpochInputs) -> ActorOutcome:
        self._clock = Clock(self._device)
        graph = self._actor.roll_out(inputs)
        self._clock.mark("rollout")
        outcome = self._actor.update_actor(graph, self._actor.compute_loss(graph))
        self._clock.mark("backward")
        self._env.release_graph()
        return outcome

    def join(self) -> None:
        """Make the current stream wait for all work started so far."""

    def seconds(self) -> dict[str, float]:
        """How long the parts of the last epoch took [s], by name; waits for them."""
        return self._clock.seconds()

    def adapt(self) -> None:
        """Adapt the number of unrolled solver iterations to the last epoch; waits for it."""
