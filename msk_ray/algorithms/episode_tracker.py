"""Returns and lengths of complete episodes in training, which span many rollouts. (Evaluations have a `Tally`.)"""

from itertools import accumulate

import torch
from torch import Tensor


class EpisodeTracker:
    """Accumulates return and length of each world's episode over rollouts."""

    def __init__(self, nworld: int, device: torch.device) -> None:
        self._return = torch.zeros(nworld, device=device)
        self._length = torch.zeros(nworld, device=device)

    def update(self, rewards: Tensor, done: Tensor) -> dict[str, Tensor]:
        """Add the rewards and ends of a rollout, both (H, W).

        Returns:
            Mean return and length of the episodes that ended in it, and their number; only the number if none did.
        """
        # With C the running total, episodes of a world that ended in the rollout sum to C at its last end.
        totals = self._return + _running_sum(rewards)
        lengths = self._length + torch.arange(1, len(rewards) + 1, device=rewards.device)[:, None]
        steps = torch.arange(len(rewards), device=rewards.device)[:, None]
        last = steps.expand_as(done).masked_fill(~done, -1).amax(0)
        ended = last >= 0
        at = last.clamp_min(0)[None]
        return_at = totals.gather(0, at)[0].masked_fill(~ended, 0.0)
        length_at = lengths.gather(0, at)[0].masked_fill(~ended, 0.0)
        self._return = totals[-1] - return_at
        self._length = lengths[-1] - length_at
        count = done.sum()
        if not count:
            return {"train/episodes": count}
        return {
            "train/episode_return": return_at.sum() / count,
            "train/episode_length": length_at.sum() / count,
            "train/episodes": count,
        }

    def state_dict(self) -> dict[str, Tensor]:
        """Running totals."""
        return {"return": self._return.clone(), "length": self._length.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from a `state_dict`."""
        self._return, self._length = state["return"], state["length"]


def _running_sum(values: Tensor) -> Tensor:
    """Cumulative sums over the first axis."""
    if values.is_cuda and torch.are_deterministic_algorithms_enabled():
        return torch.stack(list(accumulate(values)))  # torch.cumsum has no fixed order on a GPU
    return values.cumsum(0)
