"""The base of every environment: how the methods of a `Task` are run, and what they may use.

Each part has a file: `starts` (what episodes begin with), `commands`, `memory`, `reward`, `measurements` (frames,
sensors, contacts), `randomize` and `disturbances`; `contract` and `rehearsal` say what a class does wrong.

Axes: W worlds, O observation, C what the critic sees, A action, T terms of the reward.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from msk_ray.config import AS_USUAL, ExecutionConfig, PhysicsConfig
from msk_ray.config.commands import Commands
from msk_ray.envs.commands import DrawnCommands
from msk_ray.envs.contract import Contract, versions
from msk_ray.envs.disturbances import Disturbances
from msk_ray.envs.divergence import diverged_worlds
from msk_ray.envs.measurements import Measurements
from msk_ray.envs.memory import Memories, restored
from msk_ray.envs.options import FUSED_SOLVER, JACOBIANS
from msk_ray.envs.randomize import Randomizer
from msk_ray.envs.records import EnvState, Transition, rows_where
from msk_ray.envs.rehearsal import rehearse
from msk_ray.envs.reward import WeightedTerms
from msk_ray.envs.starts import Starts
from msk_ray.envs.substep_controls import SubstepControls
from msk_ray.envs.task import SettingsT, Task
from msk_ray.errors import ConfigError
from msk_ray.group import ALONE, Group
from msk_ray.step import Backward, Kernels, Simulation, StepState
from msk_ray.step.autograd.contact_state import Contact
from msk_ray.step.autograd.flags import known_none
from msk_ray.step.autograd.ground import Ground
from msk_ray.step.autograd.kinematics import Frames, Names
from msk_ray.step.autograd.sensors import Readings
from msk_ray.step.forward.capacity import Capacity


class Env(Task[SettingsT]):
    """Batched environment over a `Simulation`; a subclass writes the methods of `Task`.

    Attributes:
        state: current state of all worlds; `detach` it to start a new graph.
        generator: source of reset states, on the environment's device; replace it by one on the CPU to draw the same
            states on every device.
        active_terms: the terms that are computed.
        starts: draws what episodes begin with.
        randomizer: parameters of the model that differ between worlds; None for the model's own.
        disturbances: what else differs in training from the environment as it is scored.
        measurements: what `frames`, `sensors` and the like are read from.
        next_memory: in `reward_terms` and `fell`, what `remember` has just given.
        group: the processes that the trial's worlds are spread over; here are those of this one.
    """

    state: EnvState
    group: Group = ALONE
    policies: int = 1
    """Number of policies that act side by side, each in an equal part of the worlds, for which the same is drawn."""

    def __init__(
        self,
        config: SettingsT,
        physics: PhysicsConfig,
        nworld: int,
        device: str,
        seed: int,
        backward: Backward | None,
        execution: ExecutionConfig = AS_USUAL,
    ) -> None:
        self.config, self.nworld = config, nworld
        self.model = self.build_model(config, physics)
        self.sim = self._simulation(physics, device, backward, execution)
        self.device = self.sim.device
        self.action_size = self.model.nu
        self.generator = torch.Generator(device=self.device).manual_seed(seed)
        self.randomizer: Randomizer | None = None
        if physics.randomize is not None and physics.randomize.parameters:
            self.randomizer = Randomizer(physics.randomize, self.model, self.device, seed)
            self.sim.open_parameters(self.randomizer.parameters)
        self.weighted_terms = WeightedTerms.of(self.terms, config.reward, self.device)
        self.active_terms = self.weighted_terms.terms
        self._name_active_terms()
        ranges: Commands = getattr(config, "commands", Commands())
        self._commands = DrawnCommands.of(ranges, config.episode_length * config.control_timestep, self.device)
        self.next_memory: Mapping[str, Tensor] = {}
        self.measurements = Measurements(self.sim, type(self).__qualname__)
        self._contract = Contract(self)
        with self._contract.during("prepare"):
            self.prepare()
        first = self.randomizer.size if self.randomizer else 0
        self.disturbances = Disturbances(physics.randomize, self, first, seed)
        sources = {"randomizer": self.randomizer, "disturbances": self.disturbances}
        self.starts = Starts(self._draw_starts, sources, self._commands.size, nworld)
        with self._contract.during("memories"):
            declared = self.memories()
        self._contract.check_declared(declared)
        self._memories = Memories({**declared, **self.disturbances.memories()}, nworld, self.device)
        with self._contract.during(self._contract.start):
            self.starts.stock(self.starts.draw_steps(1, self.group))
        with self._contract.during("begin_memory"):
            self.state = self.reset_state()
        rehearse(self, self._contract)

    def _simulation(
        self, physics: PhysicsConfig, device: str, backward: Backward | None, execution: ExecutionConfig
    ) -> Simulation:
        if execution.jacobian is not None:
            self.model.opt.jacobian = JACOBIANS[execution.jacobian]
        late = physics.randomize is not None and physics.randomize.control_delay_substeps is not None
        kind = SubstepControls if late else Simulation
        return kind(
            self.model,
            self.nworld,
            round(self.config.control_timestep / self.model.opt.timestep),
            backward,
            device,
            capacity=Capacity(execution.nconmax or 0, execution.njmax or 0),
            tolerance=physics.tolerance,
            kernels=Kernels(
                execution.deterministic,
                FUSED_SOLVER[execution.solver_kernels],
                **self.solver_limits(self.model, physics),
            ),
        )

    def _name_active_terms(self) -> None:
        always = tuple(term.name for term in self.terms if not term.optional)
        # A class may have appended parts of its own.
        if self.active_terms and self.reward_names[: len(always)] == always:
            self.reward_names = (*(term.name for term in self.active_terms), *self.reward_names[len(always) :])

    @classmethod
    def overrides(cls, method: str) -> bool:
        """Whether the class has its own method of this name."""
        return getattr(cls, method) is not getattr(Env, method)

    # What the methods of a task may use

    @property
    def memory(self) -> Mapping[str, Tensor]:
        """What the worlds remember, each (W, size), by name: the part of `self.state`, in whatever method."""
        return self.state.memory

    def command(self, name: str) -> Tensor:
        """A command (W, C), in the state that `self.state` is: in `reward_terms`, that which `action` was chosen under.

        Raises:
            ConfigError: the class declares none of this name.
        """
        if name not in self._commands.draws:
            known = ", ".join(self._commands.draws) or "none"
            raise ConfigError(f"{type(self).__qualname__} has no command {name!r}; its commands: {known}")
        drawn = self.starts.split(self.state.numbers)["commands"]
        return self._commands.value(name, drawn, self.state.age * self.config.control_timestep)

    @property
    def command_ranges(self) -> Mapping[str, Tensor]:
        """Smallest and largest values of each command, (2, C), by name; change them in place."""
        return self._commands.ranges

    def task_numbers(self, numbers: Tensor) -> Tensor:
        """What `draw_start` has drawn of `EnvState.numbers`, (W, T)."""
        return self.starts.split(numbers)["task"]

    def frames(self, state: StepState) -> Frames:
        """Positions, orientations and velocities of bodies, sites, geoms and centres of mass in `state` (W worlds).

        All carry gradients. They are computed once per state, even if several functions ask for them.
        """
        return self.measurements.frames(state)

    def tendons(self, state: StepState) -> tuple[Tensor, Tensor]:
        """Lengths [m] and rates [m/s] of all tendons in `state`, each (W, ntendon); both carry gradients.

        Raises:
            UnsupportedModelError: the model has no tendons.
        """
        return self.measurements.tendons(state)

    def contact_forces(self, state: StepState, geom: Names) -> Tensor:
        """Force of all contacts on geoms [N], world coordinates: (W, 3) for one name or id, (W, n, 3) for several.

        Values only: no gradient flows through them. They are those of the last substep of the step that led to
        `state`, and 0 in a world that diverged in it. Only `remember`, `reward_terms`, `fell` and `outcome_terms` may
        use them, because `observe` is also called for states that no step has led to.

        Raises:
            ConfigError: no step has just led to `state`, or there is no such geom.
        """
        return self.measurements.contact_forces(state, geom)

    def contact(
        self, state: StepState, names: Names, kind: str = "geom", against: Names = 0, by: str = "subtree"
    ) -> Contact:
        """Contacts of named parts of the model in the step that led to `state`, n = 1 for one name.

        Values only, where and as for `contact_forces`, in each substep.

        Args:
            state: that state.
            names, kind, against, by: as for `ContactQueries`.

        Raises:
            ConfigError: no step has just led to `state`, or there is no such part.
        """
        return self.measurements.contact(state, names, kind, against, by)

    def sensors(self, state: StepState) -> Readings:
        """The model's sensors in `state`, by name: `self.sensors(state)["imu"]`, (W, D), is computed when asked.

        Those that are functions of the state carry gradients. Those of forces and accelerations are values of the step
        that led to `state`, where and as for `contact_forces`.
        """
        return self.measurements.sensors(state)

    @property
    def ground(self) -> Ground:
        """Distances to the ground: `self.ground.scan(self.frames(state), "trunk", offsets, reach)` around a body,
        `self.ground.below(points, reach)`; with the gradient of the slope where rays land.
        """
        return self.measurements.ground

    def tensor(self, values: object) -> Tensor:
        """A copy of numbers, such as a field of the model, as float32 on the environment's device."""
        return torch.tensor(np.asarray(values), dtype=torch.float32, device=self.device)

    def uniform(self, *shape: int) -> Tensor:
        """Uniform numbers in [-1, 1) from the environment's generator; zeros if resets are not stochastic."""
        if not self.config.stochastic_reset:
            return torch.zeros(shape, device=self.device)
        return 2.0 * self._draw(torch.rand, shape) - 1.0

    def normal(self, *shape: int) -> Tensor:
        """Standard normal numbers from the environment's generator, for example noise of sensors."""
        return self._draw(torch.randn, shape)

    def _draw(self, draw: Callable[..., Tensor], shape: tuple[int, ...]) -> Tensor:
        if self.policies > 1 and shape and shape[0] == self.nworld:
            # Each policy gets the numbers that it gets alone.
            shape = (self.nworld // self.policies, *shape[1:])
            return self._draw(draw, shape).repeat(self.policies, *[1] * (len(shape) - 1))
        return draw(shape, generator=self.generator, device=self.generator.device).to(self.device)

    def enter_epoch(self, epoch: int) -> None:
        """Prepare for a training epoch, counted from 0: schedules first, then what the class itself changes."""
        self.apply_schedules(epoch)
        self.begin_epoch(epoch)

    # One step

    def step(self, action: Tensor, *, auto_reset: bool = True) -> Transition:
        """Advance all worlds under actions (W, A) in [-1, 1] and reset those whose episode ended.

        A world whose physics exceeded all bounds gets no reward for the step and counts as terminated; its observation
        is that of the state before the step, cut from the graph.
        """
        before = self.disturbances.pushed(self.disturbed(self.state.physics), self.state)
        control = self.disturbances.control(self.control(action), self.state)
        force = self.applied_force(before)
        after = self.sim.step(control, *before, qfrc_applied=force, parameters=self.parameters)
        diverged = diverged_worlds(after)
        if not (all_valid := known_none(diverged)):
            # `where` sends no cotangent into a diverged world's step, so its gradient cannot reach the batch.
            after = StepState(*(rows_where(diverged, b.detach(), a) for b, a in zip(before, after, strict=True)))
        self.measurements.begin(after, diverged)
        given = versions(after, action, self.memory)
        reached = self.reached(after, action)
        with self.in_state(reached):
            observed = self.observe(after, action)
            obs = self.disturbances.observation(observed, reached)
        terms = self.reward_terms(after, action, observed)
        fell = self.fell(after)
        self._contract.check_memory("remember", reached.memory, self.memory)
        self._contract.check_results(obs, terms, fell)
        self._contract.check_unchanged("remember, observe, reward_terms or fell", given, after, action, self.memory)
        if not all_valid:
            terms = terms.masked_fill(diverged[:, None], 0.0)
        reward = terms.sum(-1)
        terminated = diverged | fell
        truncated = self.timed_out(reached) & ~terminated
        self.state = self.carried(self._reset_where(terminated | truncated, reached) if auto_reset else reached)
        return Transition(reward, terms.detach(), reached, obs, terminated, truncated, diverged)

    @property
    def parameters(self) -> dict[str, Tensor] | None:
        """Values of the model's fields that differ between worlds, by name; None for the model's own."""
        if self.randomizer is None:
            return None
        return self.randomizer.values(self.starts.split(self.state.numbers)["randomizer"])

    def reached(self, state: StepState, action: Tensor) -> EnvState:
        """The state of all worlds once `action` has led to `state`."""
        before = self.state
        if self._memories:
            self.next_memory = self._memories.ordered(self.remembered(state, action))
        return EnvState(state, action, before.age + 1, before.numbers, self.next_memory)

    def remembered(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        """What `remember` gives, and the memories of disturbances."""
        values, late = self.remember(state, action), self.disturbances.remember(self.state, action)
        return {**values, **late} if late else values

    def carried(self, state: EnvState) -> EnvState:
        """A state as the next step begins with it: the gradients of some memories do not cross steps."""
        return self._memories.carried(state) if self._memories else state

    def _reset_where(self, done: Tensor, reached: EnvState) -> EnvState:
        if known_none(done):
            self.starts.take(self.group)  # every step takes some, whether a world needs them or not
            return reached
        return reached.replaced(done, self.reset_state())

    # States between steps

    def reset_state(self) -> EnvState:
        """Fresh initial states of all worlds."""
        fresh = self.starts.take(self.group)
        return self._begun(
            EnvState(
                fresh.physics,
                torch.zeros((self.nworld, self.action_size), device=self.device),
                torch.zeros(self.nworld, dtype=torch.int64, device=self.device),
                fresh.numbers,
                self._memories.start,
            )
        )

    def _draw_starts(self, count: int) -> tuple[StepState, Tensor]:
        """What `draw_start` gives, with the draws of commands after its numbers."""
        physics, task = self.draw_start(count)
        self._contract.check_state(self._contract.start, physics, count)
        if self._commands.size:
            task = torch.cat((task, 0.5 + 0.5 * self.uniform(count, self._commands.size)), dim=-1)
        return physics, task

    def _begun(self, state: EnvState) -> EnvState:
        """The state with the memories of episodes that begin in it; it has their declared values."""
        if not self._memories:
            return state
        with self.in_state(state), torch.no_grad():
            values = self.begin_memory(state.physics)
        self._contract.check_memory("begin_memory", values, state.memory, complete=False)
        return state._replace(memory=self._memories.begun(values))

    @contextmanager
    def in_state(self, state: EnvState) -> Iterator[None]:
        """Inside the block, the worlds are in another state."""
        before = vars(self).get("state", state)
        self.state = state
        try:
            yield
        finally:
            self.state = before

    def observation(self) -> Tensor:
        """Observation (W, O) of the current state, as the policy is given it."""
        return self.disturbances.observation(self.observe(self.state.physics, self.state.action), self.state)

    def observation_of(self, reached: EnvState) -> Tensor:
        """Observation (W, O) of another state; the current one stays what it is."""
        with self.in_state(reached):
            return self.observation()

    @property
    def asymmetric(self) -> bool:
        """Whether the critic sees something other than the policy."""
        return self.overrides("observe_critic") or self.disturbances.disturbs_observations

    def critic_observation(self) -> Tensor:
        """What the critic sees of the current state, (W, C)."""
        state = self.state
        given = versions(state.physics, state.action, state.memory)
        seen = self.observe_critic(state.physics, state.action)
        self._contract.check_width("observe_critic", seen, self.critic_size)
        self._contract.check_unchanged("observe_critic", given, state.physics, state.action, state.memory)
        return seen

    def critic_observation_of(self, reached: EnvState) -> Tensor:
        """What the critic sees of another state, (W, C); the current one stays what it is."""
        with self.in_state(reached):
            return self.critic_observation()

    def release_graph(self) -> None:
        """Cut the state from the graph, and forget everything else that would keep the graph in memory."""
        self.state = self.state.detach()
        self.next_memory = {}
        self.measurements.forget()

    def spread_ages(self) -> None:
        """Give the worlds ages spread evenly over the episode length: they then reset at different times."""
        worlds = self.nworld * self.group.size
        # By multiples of the golden ratio, modulo 1, any run of neighbouring worlds is spread evenly too.
        share = torch.arange(worlds, dtype=torch.float64) * ((math.sqrt(5.0) - 1.0) / 2.0) % 1.0
        age = (share * self.config.episode_length).long().to(self.device)
        self.state = self.state._replace(age=self.group.own(age))

    def seed(self, seed: int) -> None:
        """Draw from now on as after construction with this seed."""
        self.generator.manual_seed(seed)
        self.starts.seed(seed)

    def join(self, group: Group) -> None:
        """Become the worlds of one process of a group, each of which has as many, in their initial states."""
        self.group = group
        self.seed(self.generator.initial_seed())
        self.state = self.reset_state()

    def state_dict(self) -> dict[str, Any]:
        """The state of the worlds, their parameters, the generators, and the buffer sizes that the simulation has.

        In a group, of the worlds of all processes, each of which has to call it.
        """
        state, gather = self.state, self.group.gather
        memory = {name: gather(values.detach()).clone() for name, values in state.memory.items()}
        ranges = {name: values.clone() for name, values in self.command_ranges.items()}
        return {
            "env_generator": self.generator.get_state(),
            "env_state": [gather(t.detach()).clone() for t in (*state.physics, state.action, state.age)],
            "capacity": tuple(map(max, zip(*self.group.collect(tuple(self.sim.capacity)), strict=True))),
            **self.starts.state_dict(state.numbers, self.group),
            **({"env_memory": memory} if memory else {}),
            **({"command_ranges": ranges} if ranges else {}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        # The state of a generator is a host tensor on every device.
        self.generator.set_state(state["env_generator"].cpu())
        *physics, action, age = map(self.group.own, state["env_state"])
        numbers = self.starts.load_state_dict(state, self.group, self.device)
        for name, ranges in state.get("command_ranges", {}).items():
            self.command_ranges[name].copy_(ranges)
        begun = self._begun(EnvState(StepState(*physics), action, age, numbers, self._memories.start))
        memory = {name: self.group.own(values) for name, values in state.get("env_memory", {}).items()}
        self.state = restored(begun, memory)
        if "capacity" in state:
            # The buffer sizes that the trial had grown to: the next step may need them.
            self.sim.reserve(Capacity(*state["capacity"]))
