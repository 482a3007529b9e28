"""What a class of environments says of its task: the model, the start of episodes, observation and reward.

Axes: W worlds, O observation, C what the critic sees, A action, T terms of the reward.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, TypeVar

import mujoco
import torch
from torch import Tensor

from msk_ray.config import Command, EnvSettings, PhysicsConfig, Term
from msk_ray.config.commands import settings_with_commands
from msk_ray.config.rewards import settings_with
from msk_ray.envs.layout import Entry
from msk_ray.envs.memory import Memory
from msk_ray.envs.records import EnvState
from msk_ray.envs.reward import WeightedTerms
from msk_ray.step import StepState
from msk_ray.step.forward.solver_limits import own_limits

SettingsT = TypeVar("SettingsT", bound=EnvSettings)


class Task(ABC, Generic[SettingsT]):
    """The methods that a class of environments may write. A class derives from `Env`, which runs them, and has what
    they may use.

    Attributes:
        config: the section `env` of the configuration.
        model: what `build_model` has returned.
        nworld: W.
        device: of all tensors.
        weighted_terms: those of `terms` that are computed, and their weights.
    """

    config: SettingsT
    model: mujoco.MjModel
    nworld: int
    device: torch.device
    weighted_terms: WeightedTerms
    action_size: int
    obs_size: int
    """Entries of an observation; that of the first one unless a class sets it."""
    critic_size: int
    """Entries of what the critic sees."""
    kept_worlds: int = 0
    """Worlds of every evaluation whose states `trajectory_figures` is given."""
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

    # The model, and what policies are scored under

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

    # Training

    def prepare(self) -> None:
        """Create constants on the device: copying one there in every step would make the host wait for the GPU."""

    @property
    def reads_episode_lengths(self) -> str | None:
        """The setting, if any, because of which `end_epoch` has to know how long episodes were."""
        return None

    def apply_schedules(self, epoch: int) -> None:
        """Set, in place, what the settings make a function of the epoch. It is called before `begin_epoch`, so that a
        class that overrides only that one keeps the schedules. A class with a schedule of its own extends this method
        and calls `super()`."""
        self.weighted_terms.begin_epoch(self.config, epoch)

    def begin_epoch(self, epoch: int) -> None:
        """Called before each training epoch, counted from 0: change here what depends on the progress of training.

        Keep what changes in tensors, change them in place and set `begin_epoch_in_place`: a recorded epoch reads
        tensors again each time, but a number only once.
        """

    def end_epoch(self, length: float | None) -> dict[str, float]:
        """Called after each training epoch with its env steps per episode that ended, if known; figures for logs."""
        return {}

    # How episodes begin

    @abstractmethod
    def draw_physics(self, count: int) -> StepState:
        """`count` initial physical states, drawn with `uniform`."""

    def draw_start(self, count: int) -> tuple[StepState, Tensor]:
        """Initial physical states of `count` episodes, and numbers of the task of each, (count, T), such as the phase
        of a gait to begin in: for what no command can say, because the initial state depends on it."""
        return self.draw_physics(count), torch.zeros((count, 0), device=self.device)

    def memories(self) -> Mapping[str, Memory]:
        """What the worlds remember from one env step to the next, by name. Called once, after `prepare`."""
        return {}

    def begin_memory(self, state: StepState) -> Mapping[str, Tensor]:
        """Those of the memories, (W, size), that start with other values than declared in episodes that begin in
        `state`. `self.state` is the state of the new episodes meanwhile."""
        return {}

    # One step, in its order. `self.state` is the state that it began in, with the action before and the age at which
    # `action` was chosen; but in `observe` and `observe_critic` the one reached.

    def disturbed(self, state: StepState) -> StepState:
        """The current state as a step begins with it, for example after a push."""
        return state

    def control(self, action: Tensor) -> Tensor:
        """Controls (W, nu) of the model for actions (W, A) in the current state."""
        return action

    def applied_force(self, state: StepState) -> Tensor | None:
        """Forces on the degrees of freedom during the step from `state` [N, N m], (W, nv); None for none."""
        return None

    def reference_qpos(self) -> Tensor | None:
        """Positions (W, nq) of a second body that films draw pale beside the one in `self.state`, such as the
        motion that it follows; None: there is none."""
        return None

    def remember(self, state: StepState, action: Tensor) -> Mapping[str, Tensor]:
        """All memories, (W, size), once `action` has led to `state`. Called once a step, before `observe`.

        `self.observation()` is what the policy was given when it chose `action`, with its errors and delays.
        """
        return {}

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
        or the friction of the floor. SHAC's gradient flows through it: inputs without one, such as contact forces, can
        take the value's gradient away from the others (lab/go1.md). Called as `observe` is.
        """
        return self.observe(state, action)

    def reward_terms(self, state: StepState, action: Tensor, obs: Tensor) -> Tensor:
        """Weighted parts (W, T) that sum to the reward for reaching `state`, observed as `obs`, by `action`."""
        return self.weighted_terms.values(self, state, action, obs)

    def fell(self, state: StepState) -> Tensor:
        """Worlds (W,) bool whose episode ends by itself in `state`."""
        return torch.zeros(self.nworld, dtype=torch.bool, device=self.device)

    def timed_out(self, reached: EnvState) -> Tensor:
        """Worlds (W,) bool whose episode is cut in the state reached, although later steps would count: by default
        after `episode_length` env steps."""
        return reached.age >= self.config.episode_length

    # Names and figures

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
        """Further figures of an evaluation, by name, from all states of `kept_worlds` episodes, (T, n), on CPU."""
        return {}

    def success(self, tail: dict[str, Tensor]) -> Tensor | None:
        """Worlds (W,) bool that succeeded, from the outcome terms of an episode's last second, each (T, W)."""
        return None
