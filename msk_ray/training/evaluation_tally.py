"""The first episode of each world: what an evaluation adds up of it. (In training, `EpisodeTracker` does so.)

Axes: W worlds, T reward terms.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from msk_ray.envs import Env
from msk_ray.envs.records import Transition


class Episodes(NamedTuple):
    """The first episode of each world."""

    score: Tensor
    """Return, shape (W,)."""
    length: Tensor
    """Env steps, shape (W,)."""
    fell: Tensor
    """Whether it ended with a fall, shape (W,) bool; not counting those that diverged."""
    diverged: Tensor
    """Whether it ended because the physics diverged, shape (W,) bool."""
    terms: Tensor
    """Return of each reward term, shape (W, T)."""
    outcomes: dict[str, Tensor]
    """Sum over the episode of each of the environment's outcome terms, shape (W,)."""
    success: Tensor | None
    """Whether it succeeded, shape (W,) bool; None if the environment defines no success or all episodes ended early."""

    def cpu(self) -> "Episodes":
        """A copy on the CPU."""
        return self._mapped(Tensor.cpu)

    def worlds(self, chosen: slice, *, success: bool) -> "Episodes":
        """The episodes of some worlds, with or without their success."""
        part = self._mapped(lambda value: value[chosen])
        return part if success else part._replace(success=None)

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> "Episodes":
        return self._replace(
            score=change(self.score),
            length=change(self.length),
            fell=change(self.fell),
            diverged=change(self.diverged),
            terms=change(self.terms),
            outcomes={name: change(value) for name, value in self.outcomes.items()},
            success=None if self.success is None else change(self.success),
        )


class Tally:
    """Adds up the first episode of every world, in place, so that a CUDA graph can hold it.

    Args:
        env: the worlds.
        policies: number of policies; further worlds are ignored.
        worlds: number of worlds per policy.
    """

    def __init__(self, env: Env[Any], policies: int, worlds: int) -> None:
        zeros = torch.zeros(env.nworld, device=env.device)
        self._env = env
        self._parts = [slice(k * worlds, (k + 1) * worlds) for k in range(policies)]
        self._alive = torch.arange(env.nworld, device=env.device) < policies * worlds
        self._score, self._length = zeros.clone(), zeros.clone()
        self._fell, self._diverged = torch.zeros_like(self._alive), torch.zeros_like(self._alive)
        self._terms = torch.zeros((env.nworld, len(env.reward_names)), device=env.device)
        self._outcomes: dict[str, Tensor] = {}
        self._tail: list[dict[str, Tensor]] = []
        self._ended = [False] * policies
        """Whether all episodes of a policy had ended at the last check."""

    def add(self, transition: Transition, outcome: dict[str, Tensor], *, in_tail: bool) -> None:
        """Add an env step to the worlds still in their first episode; near its end, also keep the outcome terms for
        `Env.success`."""
        alive = self._alive
        counted = {name: value.masked_fill(~alive, 0.0) for name, value in outcome.items()}
        self._score += transition.reward.masked_fill(~alive, 0.0)
        self._length += alive
        self._terms += transition.terms.masked_fill(~alive[:, None], 0.0)
        for name, value in counted.items():
            if name not in self._outcomes:
                self._outcomes[name] = torch.zeros_like(value)
            self._outcomes[name] += value
        if in_tail:
            self._tail.append(counted)
        self._fell |= alive & transition.terminated & ~transition.diverged
        self._diverged |= alive & transition.diverged
        alive &= ~(transition.terminated | transition.truncated)

    def all_ended(self) -> bool:
        """Check which policies have ended all their episodes; waits for the device."""
        running = torch.stack([self._alive[part].any() for part in self._parts]).tolist()
        self._ended = [ended or not runs for ended, runs in zip(self._ended, running, strict=True)]
        return all(self._ended)

    def episodes(self) -> list[Episodes]:
        """The episodes of each policy."""
        success = None
        if self._tail and not all(self._ended):
            met = self._env.success({name: torch.stack([t[name] for t in self._tail]) for name in self._tail[0]})
            success = None if met is None else met & ~(self._fell | self._diverged)
        whole = Episodes(self._score, self._length, self._fell, self._diverged, self._terms, self._outcomes, success)
        return [whole.worlds(part, success=not end) for part, end in zip(self._parts, self._ended, strict=True)]
