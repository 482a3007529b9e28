"""Record episodes of a policy with every state, for drawing and for statistics."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from msk_ray.evaluate.measure import Bench, Request
from msk_ray.step import StepState
from msk_ray.training import SavedPolicy
from msk_ray.training.evaluation_tally import Episodes
from msk_ray.visualize.render import States


@dataclass(frozen=True)
class Recording:
    """W episodes of one policy, from fixed initial states, without noise."""

    episodes: Episodes
    physics: str
    timestep: float
    """Duration of an env step [s]."""
    model: Any
    states: StepState
    """Shapes (T + 1, W, ·), on the CPU. If a push precedes a step, its state has the velocity after the push."""
    controls: Tensor
    """Shape (T + 1, W, nu); the last row repeats the one before."""
    applied: Tensor | None
    """Forces on the degrees of freedom [N, N m] during each step, shape (T + 1, W, nv); None for none."""
    reference: Tensor | None = None
    """`reference_qpos` in each state, shape (T + 1, W, nq); None for none."""

    @property
    def count(self) -> int:
        """Episodes W."""
        return len(self.episodes.score)

    def length(self, world: int) -> int:
        """Env steps of an episode."""
        return int(self.episodes.length[world])

    def world(self, world: int) -> States:
        """The states of one episode, the first and the last included."""
        steps = slice(0, self.length(world) + 1)
        qpos, qvel, act, ctrl = (t[steps, world].double().numpy() for t in (*self.states, self.controls))
        reference = None if self.reference is None else self.reference[steps, world].double().numpy()
        return States(self.model, qpos, qvel, act, ctrl, reference)

    def frames_at(self, world: int, fps: float) -> States:
        """One episode's states, `fps` per second of simulated time."""
        count = int(self.length(world) * self.timestep * fps) + 1
        return self.world(world).at(np.round(np.arange(count) / (fps * self.timestep)).astype(int))

    def ending(self, world: int) -> str:
        """`fell`, `diverged`, or `time` for an episode that lasted to its limit."""
        if bool(self.episodes.diverged[world]):
            return "diverged"
        return "fell" if bool(self.episodes.fell[world]) else "time"


def record(bench: Bench, policy: SavedPolicy, request: Request) -> Recording:
    """Run `request.worlds` episodes from the first of the request's seeds and keep every state.

    Raises:
        MskRayError: as for `Bench.evaluator`, or the checkpoint does not fit its environment.
    """
    evaluator, physics = bench.evaluator(policy.config, request)
    env = evaluator.env
    states: list[StepState] = []
    controls: list[Tensor] = []
    forces: list[Tensor] = []
    references: list[Tensor] = []

    def keep(state: StepState, control: Tensor) -> None:
        if (reference := env.reference_qpos()) is not None:
            references.append(reference.cpu())
        state = env.disturbed(state)
        states.append(StepState(*(t.cpu() for t in state)))
        controls.append(control.cpu())
        force = env.applied_force(state)
        if force is not None:
            forces.append(force.cpu())

    seed = request.seeds[0] if request.seeds else None
    episodes = evaluator.episodes(policy.on(env), seed, keep, bench.pace(evaluator.steps))
    return Recording(
        episodes.cpu(),
        physics,
        policy.config.env.control_timestep,
        env.model,
        StepState(*(torch.stack(parts) for parts in zip(*states, strict=True))),
        torch.stack(controls),
        torch.stack(forces) if forces else None,
        torch.stack(references) if references else None,
    )
