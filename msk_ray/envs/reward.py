"""The reward as a weighted sum of terms.

Axes: W worlds, T terms.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import torch
from torch import Tensor

from msk_ray.config import EnvSettings, Reward, Term
from msk_ray.step import StepState

if TYPE_CHECKING:
    from msk_ray.envs.task import Task


class WeightedTerms(NamedTuple):
    """The terms of a reward that are computed: all but optional ones without a weight."""

    terms: tuple[Term, ...]
    measures: tuple[Callable[..., Tensor], ...]
    """Their functions."""
    weights: Tensor
    """Their weights (T,), negative for costs."""
    shares: Tensor
    """Factors (T,) on the weights of terms with a schedule; 1 before the first epoch, and in scores."""

    @classmethod
    def of(cls, declared: Sequence[Term], reward: Reward, device: torch.device) -> Self:
        """Those of a class with their weights in a reward section."""
        terms = tuple(term for term in declared if not term.optional or term.weight_in(reward))
        weights = torch.tensor([term.sign * term.weight_in(reward) for term in terms], device=device)
        return cls(terms, tuple(term.measure for term in terms), weights, torch.ones_like(weights))

    def begin_epoch(self, settings: EnvSettings, epoch: int) -> None:
        """Set the shares of an epoch, counted from 0, in place."""
        for share, term in zip(self.shares, self.terms, strict=True):
            if term.schedule is not None:
                share.fill_(term.schedule(settings, epoch))

    def values(self, env: "Task[Any]", state: StepState, action: Tensor, obs: Tensor) -> Tensor:
        """Weighted terms (W, T); arguments as for `Env.reward_terms`."""
        values = torch.stack([measure(env, state, action, obs) for measure in self.measures], dim=-1)
        weighted = values * self.weights
        return weighted * self.shares if any(term.schedule for term in self.terms) else weighted
