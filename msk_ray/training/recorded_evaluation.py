"""An env step of an evaluation as one CUDA graph."""

import warnings
from typing import Any

import torch
from torch import Tensor

from msk_ray.envs import Env
from msk_ray.step.autograd.capture import Recording, fill
from msk_ray.training.evaluation_tally import Tally
from msk_ray.training.policy_group import PolicyGroup


class RecordedStep:
    """An env step of all policies, and the bookkeeping of its episodes, as one CUDA graph.

    Args:
        env: the worlds; until `leave`, their state is in the graph's own tensors.
        policy: the policies.
        tally: adds up the episodes.
        stream: CUDA stream to record on.

    Raises:
        RuntimeError: the environment makes the host wait for the device.
    """

    def __init__(self, env: Env[Any], policy: PolicyGroup, tally: Tally, stream: torch.cuda.Stream) -> None:
        self._env = env
        before = env.state
        self._state = before.mapped(Tensor.clone)

        def work() -> None:
            env.state = self._state
            transition = env.step(policy.act(env.observation()), auto_reset=False)
            tally.add(transition, env.outcome_terms(env.state.physics), in_tail=False)
            fill(self._state.tensors(), env.state.tensors())

        try:
            self._work = Recording(work, stream)
        finally:
            env.state = before
            env.release_graph()

    def run(self) -> None:
        """Take the step."""
        self._work.replay()

    def leave(self) -> None:
        """Copy the state reached back to the environment."""
        self._env.state = self._state
        self._env.release_graph()


def recorded_step(env: Env[Any], policy: PolicyGroup, tally: Tally, stream: torch.cuda.Stream) -> RecordedStep | None:
    """A `RecordedStep`, or None, with a warning, if it cannot be recorded."""
    drawn = env.generator.get_state()
    try:
        return RecordedStep(env, policy, tally, stream)
    except RuntimeError as error:
        torch.cuda.empty_cache()
        env.generator.set_state(drawn)  # so that the failed attempt does not change what the next step draws
        warnings.warn(
            f"an evaluation runs operation by operation: its steps cannot be recorded ({str(error).splitlines()[0]})",
            stacklevel=2,
        )
        return None
