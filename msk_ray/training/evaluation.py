"""Deterministic evaluation on fixed seeds: the canonical score."""

import math
import warnings
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from msk_ray.config import Config, PhysicsConfig, RandomizeConfig
from msk_ray.envs import env_class, make_env
from msk_ray.envs.generators import GlobalGenerators
from msk_ray.envs.records import Resets
from msk_ray.errors import ConfigError
from msk_ray.step import StepState
from msk_ray.training.evaluation_tally import Episodes, Tally
from msk_ray.training.policy_group import Policy, PolicyGroup, streams_for
from msk_ray.training.recorded_evaluation import RecordedStep, recorded_step

OnStep = Callable[[StepState, Tensor], None]
_CHECK_EVERY = 25
"""Env steps between checks whether any episode is still running."""
_EAGER_STEPS = 2
"""Env steps before one is recorded: they compile kernels and allocate buffers."""


class Evaluator:
    """Runs policies from the same initial states every time, under reference rewards and reference physics.

    The score is the return of each world's first episode under the environment's default reward weights, whatever
    weights the trial trains on, and under the physics of `evaluation.variant` (the environment's reference if null). So
    trials with different rewards or contacts are comparable. Initial states are drawn on the CPU, so they are the same
    on every device.

    Args:
        config: the trial's config; its `evaluation` section sets worlds, steps and seed.
        device: "cpu" or "cuda:N".
        physics: physics to use instead of the reference.
        varied: what to draw instead of `physics.randomize`, which does not apply here.
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
            `success_rate` where the environment defines success, and its `trajectory_figures` if it has `kept_worlds`.

        Raises:
            SimulationError: as for `episodes`.
        """
        at_once = (policies[first : first + self._policies] for first in range(0, len(policies), self._policies))
        return [figures for some in at_once for figures in self._run(some)]

    def check_kept_worlds(self) -> None:
        """Raise ConfigError if the environment wants the states of more worlds than an evaluation has."""
        wanted = self.env.kept_worlds
        if wanted > self._worlds:
            raise ConfigError(
                f"the environment keeps {wanted} worlds of every evaluation, which has {self._worlds}: write an "
                f"evaluation.nworld of {wanted} or more"
            )

    def _run(self, policies: Sequence[Policy]) -> list[dict[str, float]]:
        """The figures of each policy; at most `policies` of them."""
        kept = self.env.kept_worlds
        if not kept:
            return [self._figures(episodes) for episodes in self._episodes(policies)]
        states: list[StepState] = []
        first = torch.arange(kept, device=self.env.device)
        chosen = torch.cat([first + k * self._worlds for k in range(len(policies))])

        def keep(state: StepState, control: Tensor) -> None:
            states.append(StepState(*(part[chosen] for part in state)))

        per_policy = self._episodes(policies, on_step=keep)
        every = StepState(*(torch.stack(parts).cpu() for parts in zip(*states, strict=True)))
        figures = []
        for k, episodes in enumerate(per_policy):
            lengths = [int(length) for length in episodes.length[:kept]]
            trajectories = [
                StepState(*(part[: length + 1, k * kept + world] for part in every))
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
        env.seed(self._seed if seed is None else seed)
        self._reset()
        policy = PolicyGroup(policies, self._worlds, env, self._streams)
        tally = Tally(env, len(policies), self._worlds)
        control = torch.zeros((env.nworld, env.model.nu), device=env.device)
        tail_start = self.steps - self._tail
        as_graph = range(_EAGER_STEPS, tail_start) if on_step is None and self._can_record() else range(0)
        graph: RecordedStep | None = None
        for step in range(self.steps):
            if as_graph and step == as_graph.start:
                graph = recorded_step(env, policy, tally, self._streams[0])
            if graph is not None and step == as_graph.stop:
                graph.leave()
                graph = None
            if graph is not None:
                graph.run()
            else:
                action = policy(env.observation())
                if on_step is not None:
                    control = env.control(action)
                    on_step(env.state.physics, control)
                transition = env.step(action, auto_reset=False)
                tally.add(transition, env.outcome_terms(env.state.physics), in_tail=step >= tail_start)
            if pace is not None:
                pace(step + 1)
            if step % _CHECK_EVERY == 0 and step < self.steps - 1 and tally.all_ended():
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
        return tally.episodes()

    def _can_record(self) -> bool:
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
