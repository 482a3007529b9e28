"""Error messages that say where an observation or reward was not finite.

Axes: H env steps of a rollout, W worlds, O observation, T reward terms.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from msk_ray.envs import Env
from msk_ray.errors import Failure, SimulationError

_CAUSES = "a division by 0, or a root or logarithm of a number that can be 0 or negative"


def nonfinite_observation(
    env: Env[Any], observations: Tensor, epoch: int, done: int = 0, method: str = "observe"
) -> SimulationError | None:
    """The error for non-finite observations (H, W, O); None if all are finite. Waits for the device.

    Args:
        epoch: counted from 0.
        done: env steps of the epoch before these.
        method: what gave them: `observe` or `observe_critic`.
    """
    place = _first(observations)
    if place is None:
        return None
    step, world, entry = place
    layout = env.observation_layout() if method == "observe" else None
    name = f"entry {entry}" + (f" ({layout[entry].name})" if layout and entry < len(layout) else "")
    return SimulationError(
        f"nonfinite_observation: {name} of {method} is {float(observations[place])} in world {world} before env step "
        f"{done + step + 1} of epoch {epoch + 1}; look for {_CAUSES}",
        Failure.NONFINITE,
    )


def nonfinite_reward(env: Env[Any], terms: Sequence[Tensor], epoch: int) -> SimulationError:
    """The error for an epoch, counted from 0, with a non-finite mean reward. Waits for the device.

    `terms` are the reward terms (W, T) of each of its H steps, in this process's worlds.
    """
    values = torch.stack(list(terms))
    place = _first(values)
    if place is None:
        what = "the mean reward is not finite, although no term is"
        what = f"{what} in the worlds of this process" if env.group.size > 1 else f"{what}: they are too large"
        return SimulationError(f"nonfinite_reward: {what}", Failure.NONFINITE)
    step, world, term = place
    affected = int((~values[step, :, term].isfinite()).sum()) - 1
    more = f" (and in {affected} more)" if affected else ""
    return SimulationError(
        f"nonfinite_reward: term {env.reward_names[term]!r} of reward_terms is {float(values[place])} in world {world}"
        f"{more} at env step {step + 1} of epoch {epoch + 1}; look for {_CAUSES}",
        Failure.NONFINITE,
    )


def _first(values: Tensor) -> tuple[int, int, int] | None:
    """Index (step, world, column) of the first value that is not finite."""
    places = (~values.isfinite()).nonzero()
    if not len(places):
        return None
    step, world, column = places[0].tolist()
    return step, world, column
