"""Deterministic evaluation on fixed seeds: the canonical score."""

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from msk_ray.config import Config, PhysicsConfig, RandomizeConfig
from msk_ray.envs import Env, env_class, make_env
from msk_ray.envs.generators import GlobalGenerators
from msk_ray.envs.records import Resets, Transition
from msk_ray.errors import ConfigError
from msk_ray.step import StepState
from msk_ray.step.autograd.capture import Recording, fill
from msk_ray.training.policy_group import Policy, PolicyGroup, streams_for

OnStep = Callable[[StepState, Tensor], None]
_CHECK_EVERY = 25
"""Env steps between checks whether any episode is still running."""
_EAGER_STEPS = 2
"""Env steps before one is recorded: they compile kernels and allocate buffers."""


class Episodes(NamedTuple):
    """The first episode of each world; W worlds, T reward terms."""

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


class Evaluator:
    """Runs policies from the same initial states every time, under reference rewards and reference physics.

    The score is R_ref: the return of each world's first episode under the environment's default reward weights,
    whatever weights the trial trains on, and under the physics of `evaluation.variant` (the environment's reference if
    null). So trials with different rewards or contacts are comparable. Initial states are drawn on the CPU, so they are
    the same on every device.

    Args:
        config: the trial's config; its `evaluation` section sets worlds, steps and seed.
        device: "cpu" or "cuda:N".
        physics: physics to use instead of the reference.
        varied: model parameters to override. Randomization in training does not apply here.
        policies: number of policies that can run at the same time, each in its own `evaluation.nworld` worlds.
    """

    def __init__(
        self,
        config: Config,
        device: str,
        physics: PhysicsConfig | None = None,
        varied: RandomizeConfig | None = None,
        policies: int = 1,
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
        nworld = policies * e.nworld
        self.env = make_env(
            settings,
            physics,
            nworld,
            device,
            e.seed,
            differentiable=False,
            randomize=True,
            execution=config.execution,
        )
        self.env.generator = torch.Generator()
        self.env.policies = policies
        self._generators = GlobalGenerators(self.env.device, python=False)
        self.steps = steps
        self._policies = policies
        self._streams = streams_for(self.env.device)
        self._worlds = e.nworld
        self._tail = min(steps, math.ceil(1.0 / settings.control_timestep))

    def episodes(
        self,
        policy: Policy,
        seed: int | None = None,
        on_step: OnStep | None = None,
        pace: Callable[[int], None] | None = None,
    ) -> Episodes:
        """Run every world's first episode.

        Args:
            policy: raw observations (W, O) to actions (W, A).
            seed: seed of the initial states; None: `evaluation.seed`.
            on_step: called with the physical state before each env step and the controls (W, nu) of that step, and
                once more at the end with the last state and the controls that led to it.
            pace: called after each env step with the number of steps done.

        Raises:
            SimulationError: contacts or constraint rows were lost to a full buffer.
        """
        return self._episodes([policy], seed, on_step, pace)[0]

    def run(self, policies: Sequence[Policy]) -> list[dict[str, float]]:
        """Evaluate policies from raw observations (W, O) to actions (W, A), with the same results as one by one.

        Returns:
            For each its `score` and the standard deviation over worlds, mean episode `length`, `fall_rate`,
            `diverged_rate`, mean return of each reward term, step means of the environment's outcome terms, and
            `success_rate` where the environment defines success, and its `trajectory_figures` if it records worlds.

        Raises:
            SimulationError: as for `episodes`.
        """
        at_once = (policies[first : first + self._policies] for first in range(0, len(policies), self._policies))
        return [figures for some in at_once for figures in self._run(some)]

    def check_recorded(self) -> None:
        """Raise if the environment wants to record more worlds than `run` has.

        Raises:
            ConfigError: it wants too many.
        """
        wanted = self.env.recorded_worlds
        if wanted > self._worlds:
            raise ConfigError(
                f"the environment records {wanted} worlds of every evaluation, which has {self._worlds}: write an "
                f"evaluation.nworld of {wanted} or more"
            )

    def _run(self, policies: Sequence[Policy]) -> list[dict[str, float]]:
        """The figures of each policy; at most `policies` of them."""
        recorded = self.env.recorded_worlds
        if not recorded:
            return [self._figures(episodes) for episodes in self._episodes(policies)]
        states: list[StepState] = []
        first = torch.arange(recorded, device=self.env.device)
        chosen = torch.cat([first + k * self._worlds for k in range(len(policies))])

        def keep(state: StepState, control: Tensor) -> None:
            states.append(StepState(*(part[chosen] for part in state)))

        per_policy = self._episodes(policies, on_step=keep)
        kept = StepState(*(torch.stack(parts).cpu() for parts in zip(*states, strict=True)))
        figures = []
        for k, episodes in enumerate(per_policy):
            lengths = [int(length) for length in episodes.length[:recorded]]
            trajectories = [
                StepState(*(part[: length + 1, k * recorded + world] for part in kept))
                for world, length in enumerate(lengths)
            ]
            figures.append(self._figures(episodes) | self.env.trajectory_figures(trajectories))
        return figures

    @torch.no_grad()
    def _episodes(
        self,
        policies: Sequence[Policy],
        seed: int | None = None,
        on_step: OnStep | None = None,
        pace: Callable[[int], None] | None = None,
    ) -> list[Episodes]:
        """The episodes of each policy; at most `policies` of them."""
        env = self.env
        before = self._generators.state()
        env.generator.manual_seed(self._seed if seed is None else seed)
        self._reset()
        policy = PolicyGroup(policies, self._worlds, env, self._streams)
        record = _Record(env, len(policies), self._worlds)
        control = torch.zeros((env.nworld, env.model.nu), device=env.device)
        recorded: _RecordedStep | None = None
        for step in range(self.steps):
            in_tail = step >= self.steps - self._tail
            if step == _EAGER_STEPS and on_step is None and self._records_steps() and not in_tail:
                recorded = _recorded_step(env, policy, record, self._streams[0])
            if in_tail and recorded is not None:
                recorded.leave()
                recorded = None
            if recorded is not None:
                recorded.run()
            else:
                action = policy(env.observation())
                if on_step is not None:
                    control = env.control(action)
                    on_step(env.state.physics, control)
                record.add(env.step(action, auto_reset=False), env.outcome_terms(env.state.physics), in_tail=in_tail)
            if pace is not None:
                pace(step + 1)
            if step % _CHECK_EVERY == 0 and step < self.steps - 1 and record.all_ended():
                break
        if on_step is not None:
            on_step(env.state.physics, control)
        env.sim.diagnostics()  # raises if contacts were lost
        if (drawn := self._generators.changed(before)) is not None:
            warnings.warn(
                f"the evaluation drew from {drawn}, so its score does not repeat: draw with self.uniform(...) or "
                f"self.normal(...) in {type(env).__qualname__}, and nothing in the policy",
                stacklevel=2,
            )
        return record.episodes()

    def _records_steps(self) -> bool:
        """Whether an env step can be recorded; torch graphs cannot hold the conditional loop of mujoco_warp's
        solver."""
        return bool(self._streams) and not self.env.sim.batch.stages.unrolls

    def _reset(self) -> None:
        """Reset every policy's worlds to the same initial states."""
        drawn = self.env.starts.draw(self._worlds)
        *physics, numbers = (t.repeat(self._policies, 1) for t in (*drawn.physics, drawn.numbers))
        self.env.starts.stock(Resets(StepState(*physics), numbers))
        self.env.state = self.env.reset_state()

    def _figures(self, e: Episodes) -> dict[str, float]:
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


class _RecordedStep:
    """An env step of all policies, and the bookkeeping of its episodes, as one CUDA graph.

    Args:
        env: the worlds; until `leave`, their state is in the graph's own tensors.
        policy: the policies.
        record: collects the episodes.
        stream: CUDA stream to record on.

    Raises:
        RuntimeError: the environment makes the host wait for the device.
    """

    def __init__(self, env: Env[Any], policy: PolicyGroup, record: "_Record", stream: torch.cuda.Stream) -> None:
        self._env = env
        before = env.state
        self._state = before.mapped(Tensor.clone)

        def work() -> None:
            env.state = self._state
            transition = env.step(policy.act(env.observation()), auto_reset=False)
            record.add(transition, env.outcome_terms(env.state.physics), in_tail=False)
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


def _recorded_step(
    env: Env[Any], policy: PolicyGroup, record: "_Record", stream: torch.cuda.Stream
) -> _RecordedStep | None:
    drawn = env.generator.get_state()
    try:
        return _RecordedStep(env, policy, record, stream)
    except RuntimeError as error:
        torch.cuda.empty_cache()
        env.generator.set_state(drawn)  # so that the failed attempt does not change what the next step draws
        warnings.warn(
            f"an evaluation runs operation by operation: its steps cannot be recorded ({str(error).splitlines()[0]})",
            stacklevel=2,
        )
        return None


class _Record:
    """Collects the first episode of every world, in place, so that it can be recorded.

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
        alive &= ~transition.terminated

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
            success = None if met is None else met & self._alive
        whole = Episodes(self._score, self._length, self._fell, self._diverged, self._terms, self._outcomes, success)
        return [whole.worlds(part, success=not end) for part, end in zip(self._parts, self._ended, strict=True)]
