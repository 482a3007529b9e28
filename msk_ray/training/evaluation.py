"""Deterministic evaluation on fixed seeds: the canonical score."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from msk_ray.config import Config, PhysicsConfig, RandomizeConfig
from msk_ray.envs import env_class, make_env
from msk_ray.simulation import StepState

Policy = Callable[[Tensor], Tensor]
OnStep = Callable[[StepState, Tensor], None]
_CHECK_EVERY = 25
"""Env steps between looks at whether any world still runs."""


class Episodes(NamedTuple):
    """The first episode of each world; W worlds, T reward terms."""

    score: Tensor
    """Return, shape (W,)."""
    length: Tensor
    """Env steps, shape (W,)."""
    fell: Tensor
    """Whether it ended with a fall, shape (W,) bool; not counting those that diverged."""
    diverged: Tensor
    """Whether it ended because the physics exceeded all bounds, shape (W,) bool."""
    terms: Tensor
    """Return of each reward term, shape (W, T)."""
    outcomes: dict[str, Tensor]
    """Sum over the episode of each of the environment's outcome terms, shape (W,)."""
    success: Tensor | None
    """Whether it succeeded, shape (W,) bool; None if the environment defines no success or all episodes ended early."""

    def cpu(self) -> "Episodes":
        """The same on the CPU."""
        return self._replace(
            score=self.score.cpu(),
            length=self.length.cpu(),
            fell=self.fell.cpu(),
            diverged=self.diverged.cpu(),
            terms=self.terms.cpu(),
            outcomes={name: value.cpu() for name, value in self.outcomes.items()},
            success=None if self.success is None else self.success.cpu(),
        )


class Evaluator:
    """Runs a policy from the same initial states every time, under reference rewards and reference physics.

    The score is R_ref: the return of each world's first episode under the environment's default reward weights,
    whatever weights the trial trains on, and under the physics of `evaluation.variant` (the environment's reference if
    null). So trials with different rewards or contacts are comparable. Initial states are drawn on the CPU, so they are
    the same on every device.

    Args:
        config: the trial's config; its `evaluation` section sets worlds, steps and seed.
        device: "cpu" or "cuda:N".
        physics: physics to use instead of the reference.
        varied: parameters of the model that are other than its own. What training draws does not apply.
    """

    def __init__(
        self,
        config: Config,
        device: str,
        physics: PhysicsConfig | None = None,
        varied: RandomizeConfig | None = None,
    ) -> None:
        e = config.evaluation
        self._seed = e.seed
        env_type = env_class(config.env)
        settings = env_type.reference_settings(config.env)
        steps = e.steps or settings.episode_length
        settings = settings.model_copy(update={"episode_length": steps})
        if physics is None:
            physics = env_type.reference_physics(config.physics, e.variant)
        physics = physics.model_copy(update={"randomize": varied})
        self.env = make_env(settings, physics, e.nworld, device, e.seed, differentiable=False, randomize=True)
        self.env.generator = torch.Generator()
        self.steps = steps
        self._tail = min(steps, math.ceil(1.0 / settings.control_timestep))

    @torch.no_grad()
    def episodes(self, policy: Policy, seed: int | None = None, on_step: OnStep | None = None) -> Episodes:
        """Run every world's first episode.

        Args:
            policy: raw observations (W, O) to actions (W, A).
            seed: seed of the initial states; None: `evaluation.seed`.
            on_step: called with the physical state before each env step and the controls (W, nu) of that step, and
                once more at the end with the last state and the controls that led to it.

        Raises:
            SimulationError: contacts or constraint rows were lost to a full buffer.
        """
        env = self.env
        env.generator.manual_seed(self._seed if seed is None else seed)
        env.state = env.reset_state()
        zeros = torch.zeros(env.nworld, device=env.device)
        alive = torch.ones(env.nworld, dtype=torch.bool, device=env.device)
        score, length = zeros.clone(), zeros.clone()
        fell, diverged = ~alive, ~alive
        terms = torch.zeros((env.nworld, len(env.reward_names)), device=env.device)
        outcomes: dict[str, Tensor] = {}
        tail: list[dict[str, Tensor]] = []
        control = torch.zeros((env.nworld, env.model.nu), device=env.device)
        for step in range(self.steps):
            action = policy(env.observation())
            if on_step is not None:
                control = env.control(action)
                on_step(env.state.physics, control)
            transition = env.step(action, auto_reset=False)
            outcome = env.outcome_terms(env.state.physics)
            score += transition.reward.masked_fill(~alive, 0.0)
            length += alive
            terms += transition.terms.masked_fill(~alive[:, None], 0.0)
            _accumulate(outcomes, outcome, alive)
            if step >= self.steps - self._tail:
                tail.append({name: value.masked_fill(~alive, 0.0) for name, value in outcome.items()})
            fell |= alive & transition.terminated & ~transition.diverged
            diverged |= alive & transition.diverged
            alive &= ~transition.terminated
            if step % _CHECK_EVERY == 0 and not alive.any():
                break
        if on_step is not None:
            on_step(env.state.physics, control)
        env.sim.diagnostics()  # raises if contacts were lost
        success = None
        if tail and len(tail) == self._tail:
            met = env.success({name: torch.stack([t[name] for t in tail]) for name in tail[0]})
            success = None if met is None else met & alive
        return Episodes(score, length, fell, diverged, terms, outcomes, success)

    def run(self, policy: Policy) -> dict[str, float]:
        """Evaluate a policy from raw observations (W, O) to actions (W, A).

        Returns:
            `score` and its standard deviation over worlds, mean episode `length`, `fall_rate`, `diverged_rate`, mean
            return of each reward term, step means of the environment's outcome terms, and `success_rate` where the
            environment defines success.
        """
        e = self.episodes(policy)
        figures = {
            "score": e.score.mean(),
            "score_std": e.score.std() if len(e.score) > 1 else torch.zeros(()),
            "length": e.length.mean(),
            "fall_rate": e.fell.float().mean(),
            "diverged_rate": e.diverged.float().mean(),
            **{f"term/{name}": value for name, value in zip(self.env.reward_names, e.terms.mean(0), strict=True)},
            **{name: value.sum() / e.length.sum() for name, value in e.outcomes.items()},
        }
        if e.success is not None:
            figures["success_rate"] = e.success.float().mean()
        return {name: float(value) for name, value in figures.items()}


def _accumulate(totals: dict[str, Tensor], values: dict[str, Tensor], alive: Tensor) -> None:
    for name, value in values.items():
        totals[name] = totals.get(name, torch.zeros_like(value)) + value.masked_fill(~alive, 0.0)
