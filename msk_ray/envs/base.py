"""The base of every environment: stepping, truncation and termination, reset and divergence.

Axes: W worlds, O observation, C what the critic sees, A action.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any, ClassVar, Generic, TypeVar

import mujoco
import torch
from torch import Tensor

from msk_ray.config import AS_USUAL, Command, EnvSettings, ExecutionConfig, PhysicsConfig, Reward, Term
from msk_ray.config.commands import Commands, settings_with_commands
from msk_ray.config.rewards import settings_with
from msk_ray.envs import commands
from msk_ray.envs.contract import Contract, versions
from msk_ray.envs.disturbances import Disturbances
from msk_ray.envs.layout import Entry
from msk_ray.envs.memory import Memories, Memory, restored
from msk_ray.envs.options import FUSED_SOLVER, JACOBIANS
from msk_ray.envs.randomize import Randomizer
from msk_ray.envs.records import EnvState, Resets, Transition, rows_where
from msk_ray.errors import ConfigError
from msk_ray.group import ALONE, Group
from msk_ray.step import Backward, Kernels, Simulation, StepState
from msk_ray.step.autograd.contact_state import Contact, ContactQueries
from msk_ray.step.autograd.flags import known_none
from msk_ray.step.autograd.ground import Ground
from msk_ray.step.autograd.kinematics import Frames, Kinematics, Names, as_named
from msk_ray.step.autograd.sensors import Readings, Sensors
from msk_ray.step.autograd.tendon_lengths import Tendons
from msk_ray.step.forward.capacity import Capacity
from msk_ray.step.forward.contact_watch import FIGURES
from msk_ray.step.forward.solver_limits import own_limits

SettingsT = TypeVar("SettingsT", bound=EnvSettings)

# A world whose state exceeds this bound has diverged: no model here reaches it as long as the solver works.
_STATE_BOUND = 1e6


class Env(ABC, Generic[SettingsT]):
    """Batched environment over a `Simulation`.

    Attributes:
        state: current state of all worlds; `detach` it to start a new graph.
        generator: source of reset states, on the environment's device; replace it by one on the CPU to draw the same
            states on every device.
        active_terms: the terms that are computed.
        randomizer: parameters of the model that differ between worlds; None for the model's own.
        command_ranges: smallest and largest values of each command, (2, C), by name; change them in place.
        next_memory: in `reward_terms` and `fell`, what `remember` has just given.
        ignore_contact_forces: whether contact forces read as 0, for comparisons of gradients, because they carry none.
        group: the processes that the trial's worlds are spread over; here are those of this one.
    """

    state: EnvState
    group: Group = ALONE
    policies: int = 1
    """Number of policies that act side by side, each in an equal part of the worlds, for which the same is drawn."""
    recorded_worlds: int = 0
    """Worlds of every evaluation whose states `trajectory_figures` is given."""
    action_size: int
    obs_size: int
    """Entries of an observation; that of the first one unless a class sets it."""
    critic_size: int
    """Entries of what the critic sees."""
    terms: ClassVar[tuple[Term, ...]] = ()
    """The terms of the reward. Their weights are settings: a class whose `Settings` lack them gets such that have them.
    A class without terms has `reward_terms`, `reward_names`, `without_gradient` and a reward section of its own."""
    commands: ClassVar[tuple[Command, ...]] = ()
    """What episodes ask of the policy. Their ranges are settings, as the weights of terms are."""
    reward_names: tuple[str, ...]
    """Names of the T parts of the reward."""
    without_gradient: ClassVar[tuple[str, ...]] = ()
    """Names of those that are meant to have no gradient to state and action; others without one are warned of."""
    keeps_iterations: ClassVar[bool] = False
    """Whether the solver keeps to the iterations of the model that `build_model` returns, even if they are few."""
    begin_epoch_in_place: ClassVar[bool] = False
    """Whether `begin_epoch`, where a class has its own, only changes the contents of tensors."""
    Settings: ClassVar[type[EnvSettings]]
    """Its section of the configuration, which also lists its named physics and the physics settings it reads."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if cls.terms and hasattr(cls, "Settings"):
            cls.Settings = settings_with(cls.terms, cls.Settings, cls)
        if cls.commands and hasattr(cls, "Settings"):
            cls.Settings = settings_with_commands(cls.commands, cls.Settings, cls)
        if "terms" in vars(cls) and "reward_names" not in vars(cls):
            cls.reward_names = tuple(term.name for term in cls.terms if not term.optional)

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
        self.config = config
        self.nworld = nworld
        self.model = self.build_model(config, physics)
        if execution.jacobian is not None:
            self.model.opt.jacobian = JACOBIANS[execution.jacobian]
        self.sim = Simulation(
            self.model,
            nworld,
            round(config.control_timestep / self.model.opt.timestep),
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
        self.device = self.sim.device
        self.action_size = self.model.nu
        self.generator = torch.Generator(device=self.device).manual_seed(seed)
        self.randomizer: Randomizer | None = None
        self._randomize, self._seed = physics.randomize, seed
        if physics.randomize is not None and physics.randomize.parameters:
            self.randomizer = Randomizer(physics.randomize, self.model, self.device, seed)
            self.sim.open_parameters(self.randomizer.parameters)
        self._begin_terms()
        ranges: Commands = getattr(config, "commands", Commands())
        self._draws, self._drawn = commands.plan(ranges, config.episode_length * config.control_timestep)
        self.command_ranges = commands.ranges_of(ranges, self.device)
        self._fresh: list[Resets] = []
        self.next_memory: Mapping[str, Tensor] = {}
        self.ignore_contact_forces = False
        self._reached: StepState | None = None
        self._measured: dict[Hashable, tuple[StepState, bool, Any]] = {}
        self._contract = Contract(self)
        self._contract.begin()

    def _begin_terms(self) -> None:
        """Choose the terms that are computed: all but optional ones without a weight."""
        reward, always = self.config.reward, tuple(term.name for term in self.terms if not term.optional)
        self.active_terms = tuple(term for term in self.terms if not term.optional or term.weight_in(reward))
        if self.active_terms and self.reward_names[: len(always)] == always:
            # A class may have appended parts of its own.
            self.reward_names = (*(term.name for term in self.active_terms), *self.reward_names[len(always) :])
        self._measures = [term.measure for term in self.active_terms]
        self._weights = self.weights(reward)
        self._shares = torch.ones_like(self._weights)
        self._scheduled = any(term.schedule for term in self.active_terms)

    def _set_shares(self, epoch: int) -> None:
        """Set the factors on the weights of terms with a schedule; they are 1 before the first epoch, and in scores."""
        for share, term in zip(self._shares, self.active_terms, strict=True):
            if term.schedule is not None:
                share.fill_(term.schedule(self.config, epoch))

    def weights(self, reward: Reward) -> Tensor:
        """The weight of each of `active_terms` in a reward section, negative for costs."""
        return torch.tensor([term.sign * term.weight_in(reward) for term in self.active_terms], device=self.device)

    @classmethod
    @abstractmethod
    def build_model(cls, config: SettingsT, physics: PhysicsConfig) -> mujoco.MjModel:
        """Compile the model that these settings describe."""

    @classmethod
    def solver_limits(cls, model: mujoco.MjModel, physics: PhysicsConfig) -> dict[str, int]:
        """Limits of iterations that the solver of a model by `build_model` has to keep to, by their setting."""
        own = own_limits(model)._asdict()
        return {n: limit for n, limit in own.items() if cls.keeps_iterations or getattr(physics, n) is not None}

    @classmethod
    def reference_settings(cls, config: SettingsT) -> SettingsT:
        """`config` with the reward and the commands that policies are scored under: the defaults of their sections; the
        rest is unchanged."""
        default = {name: type(getattr(config, name))() for name in ("reward", "commands") if hasattr(config, name)}
        return config.model_copy(update=default)

    @classmethod
    def reference_physics(cls, physics: PhysicsConfig, variant: str | None) -> PhysicsConfig:
        """The physics that policies are scored under: an unchanged named variant, or `physics` if there is none."""
        variants = cls.Settings.variants
        return PhysicsConfig(variant=variant or variants[0]) if variants else physics

    def prepare(self) -> None:
        """Create constants on the device: copying one there in every step would make the host wait for the GPU."""

    @property
    def reads_episode_lengths(self) -> str | None:
        """The setting, if any, because of which `end_epoch` has to know how long episodes were."""
        return None

    def begin_epoch(self, epoch: int) -> None:
        """Called before each training epoch, counted from 0: change here what depends on the progress of training.

        Keep what changes in tensors, change them in place and set `begin_epoch_in_place`: a recorded epoch reads
        tensors again each time, but a number only once. Call this one too: it sets the schedules of terms.
        """
        self._set_shares(epoch)

    def end_epoch(self, length: float | None) -> dict[str, float]:
        """Called after each training epoch with its env steps per episode that ended, if known; figures for logs."""
        return {}

    def memories(self) -> Mapping[str, Memory]:
        """What the worlds remember from one env step to the next, by name. Called once, after `prepare`."""
        return {}

    @property
    def memory(self) -> Mapping[str, Tensor]:
        """What the worlds remember, each (W, size), by name: the part of `self.state`, in whatever method."""
        return self.state.memory

    def begin_memory(self, state: StepState) -> Mapping[str, Tensor]:
        """Those of the memories, (W, size), that start with other values than declared in episodes that begin in
        `state`. `self.state` is the state of the new episodes meanwhile."""
        return {}

    def remember(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        """All memories, (W, size), once `action` has led to `state`. Called once a step, before `observe`.

        As in `reward_terms`, `self.state` and `self.memory` are those that the step began with.
        """
        return {}

    def control(self, action: Tensor) -> Tensor:
        """Controls (W, nu) of the model for actions (W, A) in the current state."""
        return action

    def disturbed(self, state: StepState) -> StepState:
        """The current state as a step begins with it, for example after a push."""
        return state

    def applied_force(self, state: StepState) -> Tensor | None:
        """Forces on the degrees of freedom during the step from `state` [N, N m], (W, nv); None for none."""
        return None

    @abstractmethod
    def draw_physics(self, count: int) -> StepState:
        """`count` initial physical states, drawn with `uniform`."""

    @abstractmethod
    def observe(self, state: StepState, action: Tensor) -> Tensor:
        """Observation (W, O) of a state and the action that led to it.

        Both are those of `self.state` meanwhile, whose `age`, `numbers` and `memory` are therefore those of the
        observed state, in `step` as in `observation`.
        """

    def observe_critic(self, state: StepState, action: Tensor) -> Tensor:
        """What the critic sees (W, C) of a state and the action that led to it: by default what the policy sees, but
        undisturbed.

        It is needed in training only, and may contain what no sensor of a robot tells, such as the height of its feet
        or the friction of the floor. Called as `observe` is.
        """
        return self.observe(state, action)

    @property
    def asymmetric(self) -> bool:
        """Whether the critic sees something other than the policy."""
        own = type(self).observe_critic is not Env.observe_critic
        return own or (self.disturbances is not None and self.disturbances.of_observations)

    def reward_terms(self, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
        """Weighted parts (W, T) that sum to the reward for reaching `state`, observed as `obs`, by `action`.

        `self.state` is the state that the step began in, with the action before and the age at which `action` was
        chosen; so it is in `control`, `disturbed`, `applied_force` and `fell`.
        """
        values = [measure(self, state, action, obs) for measure in self._measures]
        weighted = torch.stack(values, dim=-1) * self._weights
        return weighted * self._shares if self._scheduled else weighted

    def fell(self, state: StepState) -> Tensor:
        """Worlds (W,) bool whose episode ends by itself in `state`."""
        return torch.zeros(self.nworld, dtype=torch.bool, device=self.device)

    def observation_layout(self) -> list[Entry] | None:
        """Name and unit of each of the O entries of an observation, for those who use a policy elsewhere; None if the
        environment does not say."""
        return None

    def action_names(self) -> list[str] | None:
        """Name of each of the A entries of an action; None if they are not the model's actuators, one by one."""
        if self.action_size != self.model.nu:
            return None
        return [self.model.actuator(i).name or f"actuator_{i}" for i in range(self.model.nu)]

    def outcome_terms(self, state: StepState) -> dict[str, Tensor]:
        """Further quantities per world (W,) that the evaluation averages over an episode."""
        return {}

    def trajectory_figures(self, trajectories: Sequence[StepState]) -> dict[str, float]:
        """Further figures of an evaluation, by name, from all states of `recorded_worlds` episodes, (T, n), on CPU."""
        return {}

    def success(self, tail: dict[str, Tensor]) -> Tensor | None:
        """Worlds (W,) bool that succeeded, from the outcome terms of an episode's last second, each (T, W)."""
        return None

    def reset_state(self) -> EnvState:
        """Fresh initial states of all worlds."""
        fresh = self._next_resets()
        return self._begun(
            EnvState(
                fresh.physics,
                torch.zeros((self.nworld, self.action_size), device=self.device),
                torch.zeros(self.nworld, dtype=torch.int64, device=self.device),
                fresh.numbers,
                self._memories.start,
            )
        )

    def _begun(self, state: EnvState) -> EnvState:
        """The state with the memories of episodes that begin in it; it has their declared values."""
        if not self._memories:
            return state
        with self.in_state(state), torch.no_grad():
            values = self.begin_memory(state.physics)
        self._contract.check_memory("begin_memory", values, state.memory, complete=False)
        return state._replace(memory=self._memories.begun(values))

    @cached_property
    def _memories(self) -> Memories:
        declared = self.memories()
        self._contract.check_declared(declared)
        own = {} if self.disturbances is None else self.disturbances.memories()
        return Memories({**declared, **own}, self.nworld, self.device)

    @cached_property
    def disturbances(self) -> Disturbances | None:
        """What else than parameters of the model differs from the environment as it is scored; made after `prepare`."""
        drawn = self._randomize
        return Disturbances(drawn, self, self._seed) if drawn is not None and drawn.disturbs else None

    def spread_ages(self) -> None:
        """Give the worlds ages spread evenly over the episode length: they then reset at different times."""
        worlds = self.nworld * self.group.size
        # By multiples of the golden ratio, modulo 1, any run of neighbouring worlds is spread evenly too.
        share = torch.arange(worlds, dtype=torch.float64) * ((math.sqrt(5.0) - 1.0) / 2.0) % 1.0
        age = (share * self.config.episode_length).long().to(self.device)
        self.state = self.state._replace(age=self.group.own(age))

    def _next_resets(self) -> Resets:
        return self._fresh.pop() if self._fresh else self.draw_resets(1)

    def release_graph(self) -> None:
        """Cut the state from the graph, and forget everything else that would keep the graph in memory."""
        self.state = self.state.detach()
        self.next_memory = {}
        self._reached = None
        self._measured = {}

    def draw_resets(self, steps: int) -> Resets:
        """What the episodes that may begin in the next `steps` env steps begin with, one step after the other.

        In a group, every process draws for all worlds, and keeps what its own begin with.
        """
        worlds = self.nworld * self.group.size
        drawn = self.draw_episodes(steps * worlds)

        def own(values: Tensor) -> Tensor:
            return self.group.own(values.unflatten(0, (steps, worlds)), dim=1).flatten(0, 1)

        return Resets(StepState(*map(own, drawn.physics)), own(drawn.numbers))

    def draw_episodes(self, count: int) -> Resets:
        """What `count` episodes begin with."""
        physics, task = self.draw_start(count)
        self._contract.check_start(physics, count)
        if self._drawn:
            task = torch.cat((task, 0.5 + 0.5 * self.uniform(count, self._drawn)), dim=-1)
        drawn = [source.draw(count) for source in self.randomized.values()]
        return Resets(physics, torch.cat((*drawn, task), dim=-1) if drawn else task)

    @property
    def randomized(self) -> dict[str, Randomizer | Disturbances]:
        """What draws the numbers of `physics.randomize` for an episode, in the order of `EnvState.numbers`."""
        both = {"randomizer": self.randomizer, "disturbances": self.disturbances}
        return {name: source for name, source in both.items() if source is not None}

    def draw_start(self, count: int) -> tuple[StepState, Tensor]:
        """Initial physical states of `count` episodes, and numbers of the task of each, (count, T), such as the phase
        of a gait to begin in: for what no command can say, because the initial state depends on it."""
        return self.draw_physics(count), torch.zeros((count, 0), device=self.device)

    def join(self, group: Group) -> None:
        """Become the worlds of one process of a group, each of which has as many, in their initial states."""
        self.group = group
        self.generator.manual_seed(self.generator.initial_seed())
        for source in self.randomized.values():
            source.generator.manual_seed(source.generator.initial_seed())
        self.state = self.reset_state()

    def stock_resets(self, drawn: Resets | None) -> None:
        """Take resets from those drawn by `draw_resets`; None: draw each when it is needed."""
        self._fresh = []
        if drawn is not None:
            *physics, numbers = (t.split(self.nworld) for t in (*drawn.physics, drawn.numbers))
            self._fresh = [Resets(StepState(*p), n) for *p, n in zip(*physics, numbers, strict=True)]

    @property
    def parameters(self) -> dict[str, Tensor] | None:
        """Values of the model's fields that differ between worlds, by name; None for the model's own."""
        return None if self.randomizer is None else self.randomizer.values(self._numbers["randomizer"])

    @property
    def disturbance_numbers(self) -> Tensor:
        """The numbers of `disturbances`, (W, D)."""
        return self._numbers["disturbances"]

    def task_numbers(self, numbers: Tensor) -> Tensor:
        """What `draw_start` has drawn of `EnvState.numbers`, (W, T)."""
        task = self._split(numbers)["task"]
        return task[:, : task.shape[1] - self._drawn] if self._drawn else task

    def command(self, name: str) -> Tensor:
        """A command (W, C), in the state that `self.state` is: in `reward_terms`, that which `action` was chosen under.

        Raises:
            ConfigError: the class declares none of this name.
        """
        if name not in self._draws:
            known = ", ".join(self._draws) or "none"
            raise ConfigError(f"{type(self).__qualname__} has no command {name!r}; its commands: {known}")
        drawn = self.state.numbers[:, self.state.numbers.shape[1] - self._drawn :]
        time = self.state.age * self.config.control_timestep
        return self._draws[name].value(drawn, time, self.command_ranges[name])

    @property
    def _numbers(self) -> dict[str, Tensor]:
        return self._split(self.state.numbers)

    def _split(self, numbers: Tensor) -> dict[str, Tensor]:
        """Columns of each source of `randomized`, and of the `task`: T by `draw_start`, then those of the commands."""
        sizes = {name: source.size for name, source in self.randomized.items()}
        sizes["task"] = numbers.shape[1] - sum(sizes.values())
        return dict(zip(sizes, numbers.split(list(sizes.values()), dim=1), strict=True))

    def state_dict(self) -> dict[str, Any]:
        """The state of the worlds, their parameters, the generators, and the buffer sizes that the simulation has.

        In a group, of the worlds of all processes, each of which has to call it.
        """
        state, gather = self.state, self.group.gather
        numbers = {name: gather(part).clone() for name, part in self._numbers.items()}
        task = numbers["task"]
        memory = {name: gather(values.detach()).clone() for name, values in state.memory.items()}
        return {
            "env_generator": self.generator.get_state(),
            "env_state": [gather(t.detach()).clone() for t in (*state.physics, state.action, state.age)],
            "capacity": tuple(map(max, zip(*self.group.collect(tuple(self.sim.capacity)), strict=True))),
            "randomizer": None,
            **{
                name: {"numbers": numbers[name], "generator": source.generator.get_state()}
                for name, source in self.randomized.items()
            },
            **({"env_task": task} if task.shape[1] else {}),
            **({"env_memory": memory} if memory else {}),
            **({"command_ranges": {n: t.clone() for n, t in self.command_ranges.items()}} if self._drawn else {}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        # The state of a generator is a host tensor on every device.
        self.generator.set_state(state["env_generator"].cpu())
        *physics, action, age = map(self.group.own, state["env_state"])
        numbers = [torch.zeros((self.nworld, 0), device=self.device)]
        for name, source in self.randomized.items():
            numbers.append(self.group.own(state[name]["numbers"].to(self.device)))
            source.generator.set_state(state[name]["generator"].cpu())
        if "env_task" in state:
            numbers.append(self.group.own(state["env_task"].to(self.device)))
        for name, ranges in state.get("command_ranges", {}).items():
            self.command_ranges[name].copy_(ranges)
        begun = self._begun(
            EnvState(StepState(*physics), action, age, torch.cat(numbers, dim=-1), self._memories.start)
        )
        memory = {name: self.group.own(values) for name, values in state.get("env_memory", {}).items()}
        self.state = restored(begun, memory)
        if "capacity" in state:
            # The buffer sizes that the trial had grown to: the next step may need them.
            self.sim.reserve(Capacity(*state["capacity"]))

    def observation(self) -> Tensor:
        """Observation (W, O) of the current state, as the policy is given it."""
        return self._given(self.observe(self.state.physics, self.state.action))

    def _given(self, obs: Tensor) -> Tensor:
        return obs if self.disturbances is None else self.disturbances.observation(obs)

    def observation_of(self, reached: EnvState) -> Tensor:
        """Observation (W, O) of another state; the current one stays what it is."""
        with self.in_state(reached):
            return self.observation()

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

    @contextmanager
    def in_state(self, state: EnvState) -> Iterator[None]:
        """Inside the block, the worlds are in another state."""
        before = vars(self).get("state", state)
        self.state = state
        try:
            yield
        finally:
            self.state = before

    def reached(self, state: StepState, action: Tensor) -> EnvState:
        """The state of all worlds once `action` has led to `state`."""
        before = self.state
        if self._memories:
            self.next_memory = self._memories.ordered(self.remembered(state, action))
        return EnvState(state, action, before.age + 1, before.numbers, self.next_memory)

    def remembered(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        """What `remember` gives, and the memories of disturbances."""
        values = self.remember(state, action)
        return values if self.disturbances is None else {**values, **self.disturbances.remember(action)}

    def carried(self, state: EnvState) -> EnvState:
        """A state as the next step begins with it: the gradients of some memories do not cross steps."""
        return self._memories.carried(state) if self._memories else state

    def step(self, action: Tensor, *, auto_reset: bool = True) -> Transition:
        """Advance all worlds under actions (W, A) in [-1, 1] and reset those whose episode ended.

        A world whose physics exceeded all bounds gets no reward for the step and counts as terminated; its observation
        is that of the state before the step, cut from the graph.
        """
        before = self.disturbed(self.state.physics)
        control = self.control(action)
        if self.disturbances is not None:
            before, control = self.disturbances.pushed(before), self.disturbances.control(control)
        force = self.applied_force(before)
        after = self.sim.step(control, *before, qfrc_applied=force, parameters=self.parameters)
        diverged = ~self._is_valid(after)
        if not (all_valid := known_none(diverged)):
            # `where` sends no cotangent into a diverged world's step, so its gradient cannot reach the batch.
            after = StepState(*(rows_where(diverged, b.detach(), a) for b, a in zip(before, after, strict=True)))
        self._reached, self._diverged = after, diverged
        given = versions(after, action, self.memory)
        reached = self.reached(after, action)
        with self.in_state(reached):
            observed = self.observe(after, action)
            obs = self._given(observed)
        terms = self.reward_terms(after, action, observed)
        fell = self.fell(after)
        self._contract.check_memory("remember", reached.memory, self.memory)
        self._contract.check_results(obs, terms, fell)
        self._contract.check_unchanged("remember, observe, reward_terms or fell", given, after, action, self.memory)
        if not all_valid:
            terms = terms.masked_fill(diverged[:, None], 0.0)
        reward = terms.sum(-1)
        terminated = diverged | fell
        truncated = (reached.age >= self.config.episode_length) & ~terminated
        self.state = self.carried(self._reset_where(terminated | truncated, reached) if auto_reset else reached)
        return Transition(reward, terms.detach(), reached, obs, terminated, truncated, diverged)

    def frames(self, state: StepState) -> Frames:
        """Positions, orientations and velocities of bodies, sites, geoms and centres of mass in `state` (W worlds).

        All carry gradients. They are computed once per state, even if several functions ask for them.
        """
        frames: Frames = self._once("frames", state, lambda: self._kinematics(state.qpos, state.qvel))
        return frames

    def tendons(self, state: StepState) -> tuple[Tensor, Tensor]:
        """Lengths [m] and rates [m/s] of all tendons in `state`, each (W, ntendon); both carry gradients.

        Raises:
            UnsupportedModelError: the model has no tendons.
        """
        found: tuple[Tensor, Tensor] = self._once("tendons", state, lambda: self._tendons(state.qpos, state.qvel))
        return found

    def contact_forces(self, state: StepState, geom: Names) -> Tensor:
        """Force of all contacts on geoms [N], world coordinates: (W, 3) for one name or id, (W, n, 3) for several.

        Values only: no gradient flows through them. They are those of the last substep of the step that led to
        `state`, and 0 in a world that diverged in it. Only `remember`, `reward_terms`, `fell` and `outcome_terms` may
        use them, because `observe` is also called for states that no step has led to.

        Raises:
            ConfigError: no step has just led to `state`, or there is no such geom.
        """
        if self.ignore_contact_forces:
            return torch.zeros_like(self.frames(state).geom_position(geom))
        self._require_step(state, "contact forces")
        force = self._once("contact_forces", state, self.sim.contact_forces)
        chosen = as_named(force[:, self._kinematics.indices("geom", geom)], geom)
        return chosen.masked_fill(self._diverged.view(-1, *[1] * (chosen.dim() - 1)), 0.0)

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
        query = self._contact_queries(names, kind, against, by)
        if self.ignore_contact_forces:
            self.sim.measure_contacts(query)
            substeps, size = self.sim.substeps, len(query.primary)
            return Contact.of(torch.zeros((substeps, self.nworld, size, FIGURES), device=self.device))
        self._require_step(state, "contacts")
        contact: Contact = self._once(query, state, lambda: self.sim.contacts(query))
        return contact.without(self._diverged)

    def sensors(self, state: StepState) -> Readings:
        """The model's sensors in `state`, by name: `self.sensors(state)["imu"]`, (W, D), is computed when asked.

        Those that are functions of the state carry gradients. Those of forces and accelerations are values of the step
        that led to `state`, where and as for `contact_forces`.
        """
        frames, tendons = lambda: self.frames(state), lambda: self.tendons(state)
        readings: Readings = self._once(
            "sensors",
            state,
            lambda: Readings(self._sensors, state.qpos, state.qvel, frames, tendons, lambda: self._sensordata(state)),
        )
        return readings

    @cached_property
    def ground(self) -> Ground:
        """Distances to the ground: `self.ground.scan(self.frames(state), "trunk", offsets, reach)` around a body,
        `self.ground.below(points, reach)`; with the gradient of the slope where rays land.
        """
        return Ground(self.sim.batch)

    def _sensordata(self, state: StepState) -> Tensor:
        if self.ignore_contact_forces:
            self.sim.measure_sensors()
            return torch.zeros((self.nworld, self.model.nsensordata), device=self.device)
        self._require_step(state, "sensors of forces and accelerations")
        return self.sim.sensordata().masked_fill(self._diverged[:, None], 0.0)

    def _require_step(self, state: StepState, what: str) -> None:
        if state is not self._reached:
            raise ConfigError(
                f"{type(self).__qualname__}: {what} belong to a step, not to a state: use them in "
                "remember, reward_terms, fell or outcome_terms, not in observe"
            )

    def _once(self, what: Hashable, state: StepState, measure: Callable[[], Any]) -> Any:
        """The result of `measure` for `state`, cached until another state is asked for."""
        grad = torch.is_grad_enabled()
        kept = self._measured.get(what)
        if kept is None or kept[0] is not state or kept[1] != grad:
            kept = self._measured[what] = (state, grad, measure())
        return kept[2]

    def measure_by(self, kinematics: Kinematics, tendons: Tendons, ground: Ground) -> None:
        """Measure with these, for example with those of a simulation in float64."""
        self._kinematics, self._tendons, self.ground = kinematics, tendons, ground
        self._sensors = Sensors(kinematics, lambda: tendons)
        self._measured = {}

    @cached_property
    def _kinematics(self) -> Kinematics:
        return Kinematics(self.sim.batch)

    @cached_property
    def _contact_queries(self) -> ContactQueries:
        return ContactQueries(self._kinematics)

    @cached_property
    def _sensors(self) -> Sensors:
        return Sensors(self._kinematics, lambda: self._tendons)

    @cached_property
    def _tendons(self) -> Tendons:
        return Tendons(self.sim.batch)

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

    def _reset_where(self, done: Tensor, reached: EnvState) -> EnvState:
        if known_none(done):
            self._next_resets()  # every step takes some, whether a world needs them or not
            return reached
        return reached.replaced(done, self.reset_state())

    @torch.no_grad()
    def _is_valid(self, state: StepState) -> Tensor:
        # NaN compares false, so one comparison finds both non-finite values and those out of bounds.
        return (torch.cat(state, dim=-1).abs() < _STATE_BOUND).all(-1)
