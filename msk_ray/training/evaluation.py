"""Deterministic evaluation on fixed seeds: the canonical score."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from msk_ray.config import Config
from msk_ray.envs import env_class, make_env

Policy = Callable[[Tensor], Tensor]
_CHECK_EVERY = 25
"""Env steps between looks at whether any world still runs."""


class Evaluator:
    """Runs a policy from the same initial states every time, under reference rewards and reference physics.

    The score is R_ref: the return of each world's first episode under the environment's own reward weights, whatever
    weights the trial trains on, and under the physics `evaluation.variant` names (the environment's reference if
    null). So trials with different rewards or contacts are comparable.
    """

    def __init__(self, config: Config, device: str) -> None:
        e = config.evaluation
        self._seed = e.seed
        env_type = env_class(config.env)
        settings = env_type.reference_settings(config.env)
        steps = e.steps or settings.episode_length
        settings = settings.model_copy(update={"episode_length": steps})
        physics = env_type.reference_physics(config.physics, e.variant)
        self.env = make_env(settings, physics, e.nworld, device, e.seed, differentiable=False)
        self.steps = steps
        self._tail = min(steps, math.ceil(1.0 / settings.control_timestep))

    @torch.no_grad()
    def run(self, policy: Policy) -> dict[str, float]:
        """Evaluate a policy from raw observations (W, O) to actions (W, A).

        Returns:
            `score` and its standard deviation over worlds, mean episode `length`, `fall_rate`, `diverged_rate`, mean
            return of each reward term, episode means of the environment's outcome terms, and `success_rate` where
            the environment defines success.
        """
        env = self.env
        env.generator.manual_seed(self._seed)
        env.state = env.reset_state()
        zeros = torch.zeros(env.nworld, device=env.device)
        alive = torch.ones(env.nworld, dtype=torch.bool, device=env.device)
        score, length = zeros.clone(), zeros.clone()
        fell, diverged = ~alive, ~alive
        terms = torch.zeros((env.nworld, len(env.reward_names)), device=env.device)
        outcomes: dict[str, Tensor] = {}
        tail: list[dict[str, Tensor]] = []
        for step in range(self.steps):
            transition = env.step(policy(env.observation()), auto_reset=False)
            outcome = env.outcome_terms(env.state.physics)
            score += torch.where(alive, transition.reward, 0.0)
            length += alive
            terms += torch.where(alive[:, None], transition.terms, 0.0)
            _accumulate(outcomes, outcome, alive)
            if step >= self.steps - self._tail:
                tail.append({name: torch.where(alive, value, 0.0) for name, value in outcome.items()})
            fell |= alive & transition.terminated & ~transition.diverged
            diverged |= alive & transition.diverged
            alive &= ~transition.terminated
            if step % _CHECK_EVERY == 0 and not alive.any():
                break
        env.sim.diagnostics()  # raises if contacts were lost
        figures = {
            "score": score.mean(),
            "score_std": score.std() if env.nworld > 1 else zeros.sum(),
            "length": length.mean(),
            "fall_rate": fell.float().mean(),
            "diverged_rate": diverged.float().mean(),
            **{f"term/{name}": value for name, value in zip(env.reward_names, terms.mean(0), strict=True)},
            **{name: value.sum() / length.sum() for name, value in outcomes.items()},
        }
        if tail and len(tail) == self._tail:
            success = env.success({name: torch.stack([t[name] for t in tail]) for name in tail[0]})
            if success is not None:
                figures["success_rate"] = (success & alive).float().mean()
        return {name: float(value) for name, value in figures.items()}


def _accumulate(totals: dict[str, Tensor], values: dict[str, Tensor], alive: Tensor) -> None:
    for name, value in values.items():
        totals[name] = totals.get(name, torch.zeros_like(value)) + torch.where(alive, value, 0.0)
