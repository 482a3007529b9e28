"""Several policies that act at the same time, each in its own part of the worlds."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from msk_ray.envs import Env
from msk_ray.step.autograd.capture import Recording, fill

Policy = Callable[[Tensor], Tensor]
"""Raw observations (W, O) to actions (W, A)."""
_STREAMS = 5
"""One on which a group is recorded, and others on which its policies run."""


def streams_for(device: torch.device) -> list[torch.cuda.Stream]:
    """CUDA streams for groups of policies, none on another device.

    Make them once: cuBLAS keeps a workspace for each stream that it was used on.
    """
    return [torch.cuda.Stream(device) for _ in range(_STREAMS)] if device.type == "cuda" else []


class PolicyGroup:
    """Policies as one: raw observations (W, O) of all worlds to actions (W, A); 0 in worlds that no policy has.

    On CUDA, several policies run side by side, and what they launch is recorded in the second call and then replayed:
    launched one by one, their small kernels would take longer than the step of all worlds.

    Args:
        policies: they must not change while the group is used.
        worlds: number of worlds of each.
        env: the worlds, at least `worlds` for each policy.
        streams: those of `streams_for` the device, which no other group uses at the same time.
    """

    def __init__(
        self, policies: Sequence[Policy], worlds: int, env: Env[Any], streams: Sequence[torch.cuda.Stream]
    ) -> None:
        self._policies = policies
        self._worlds = worlds
        self._idle = torch.zeros((env.nworld - len(policies) * worlds, env.action_size), device=env.device)
        self._streams = streams
        self._records = bool(streams) and len(policies) > 1
        self._recording: Recording[Tensor] | None = None
        self._obs: Tensor | None = None
        if self._records:
            # torch hands out the same streams again after 32: a recording that still runs may share a workspace.
            torch.cuda.synchronize(env.device)

    def __call__(self, obs: Tensor) -> Tensor:
        if not self._records:
            return self._act(obs)
        if self._obs is None:  # the first call prepares what cannot be made while recording
            self._obs = obs.clone()
            return self._act(obs)
        if self._recording is None:
            self._record(self._obs)
        if self._recording is None:
            return self._act(obs)
        fill([self._obs], [obs])
        return self._recording.replay().clone()  # the state keeps it while the next replay overwrites it

    def act(self, obs: Tensor) -> Tensor:
        """The same, launched one by one, to be recorded as a part of something larger."""
        return self._act_side_by_side(obs) if self._records else self._act(obs)

    def _act(self, obs: Tensor) -> Tensor:
        actions = [p(obs[k * self._worlds : (k + 1) * self._worlds]) for k, p in enumerate(self._policies)]
        return torch.cat([*actions, self._idle])

    def _act_side_by_side(self, obs: Tensor) -> Tensor:
        main, sides = torch.cuda.current_stream(obs.device), self._streams[1:]
        for side in sides:
            side.wait_stream(main)
        actions = []
        for k, policy in enumerate(self._policies):
            with torch.cuda.stream(sides[k % len(sides)]):
                actions.append(policy(obs[k * self._worlds : (k + 1) * self._worlds]))
        for side in sides:
            main.wait_stream(side)
        return torch.cat([*actions, self._idle])

    def _record(self, obs: Tensor) -> None:
        try:
            self._recording = Recording(lambda: self._act_side_by_side(obs), self._streams[0])
        except RuntimeError as error:
            self._records = False
            torch.cuda.empty_cache()
            warnings.warn(
                f"policies are evaluated one after the other: they cannot be recorded ({str(error).splitlines()[0]})",
                stacklevel=2,
            )
