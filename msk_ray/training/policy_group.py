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
"""One stream to record a group on, and others to run its policies on."""


def streams_for(device: torch.device) -> list[torch.cuda.Stream]:
    """CUDA streams for groups of policies; empty for a CPU.

    Create them once: cuBLAS keeps a workspace for every stream it has run on.
    """
    return [torch.cuda.Stream(device) for _ in range(_STREAMS)] if device.type == "cuda" else []


class PolicyGroup:
    """Several policies as one: raw observations (W, O) of all worlds to actions (W, A); 0 in worlds without a policy.

    On CUDA, the policies run in parallel on several streams; the second call records their launches, and later calls
    replay them. Launched one by one, their small kernels would take longer than the step of all worlds.

    Args:
        policies: they must not change while the group is used.
        worlds: number of worlds of each.
        env: the worlds, at least `worlds` for each policy.
        streams: from `streams_for`; no other group may use them at the same time.
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
            # torch reuses its 32 streams in turn: a recording that is still running may share a workspace.
            torch.cuda.synchronize(env.device)

    def __call__(self, obs: Tensor) -> Tensor:
        if not self._records:
            return self._act(obs)
        if self._obs is None:  # the first call creates what cannot be created while recording
            self._obs = obs.clone()
            return self._act(obs)
        if self._recording is None:
            self._record(self._obs)
        if self._recording is None:
            return self._act(obs)
        fill([self._obs], [obs])
        return self._recording.replay().clone()  # the caller keeps it, and the next replay overwrites it

    def act(self, obs: Tensor) -> Tensor:
        """The same, launched one by one, for recording as a part of a larger graph."""
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
