"""Disturbances in training besides random parameters of the model: errors and delays of observations, delays of
controls, and kicks.

All of them are functions of numbers drawn when an episode begins, of the episode's age, and of memories. A step draws
nothing, so the same state always gives the same observation.

Axes: W worlds, O observation, M measured entries of the observation (all but remembered ones), D numbers drawn for an
episode.
"""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import mujoco
import torch
from torch import Tensor

from msk_ray.config import Push, RandomizeConfig
from msk_ray.config.randomize import UNDISTURBED
from msk_ray.envs.commands import Draws
from msk_ray.envs.generators import seed_stream
from msk_ray.envs.layout import Entry
from msk_ray.envs.memory import Memory
from msk_ray.envs.observation_errors import UNIFORM_BITS, EncoderErrors, EntryErrors
from msk_ray.envs.records import EnvState
from msk_ray.errors import ConfigError
from msk_ray.step import StepState

if TYPE_CHECKING:
    from msk_ray.envs.base import Env

_STREAM = 2
"""Number of the random stream, for `seed_stream`."""
_OBSERVATIONS, _CONTROLS, _STEPS = "earlier observations", "earlier controls", "earlier steps"
"""Names of memories: observations and controls of earlier env steps, newest first, and the number of these steps."""
_LOW_HALF = 0xFFFFFFFF


class Disturbances:
    """The disturbances of a `randomize` section in all worlds of an environment.

    Args:
        config: the section; None: nothing is disturbed.
        env: the environment, prepared.
        first: column of `EnvState.numbers` in which its numbers begin.
        seed: seed of the environment. The numbers come from a generator of their own, so that initial states, commands
            and parameters of the model are the same as without disturbances.

    Attributes:
        generator: source of the numbers of episodes.
        size: count D of the numbers of an episode.
        disturbs_observations: whether the policy may be given something other than what `observe` returns.

    Raises:
        ConfigError: the observation has no entries, or the model no joints, of the names in the section; or the
            environment does not name its entries; or controls are late by more substeps than an env step has.
    """

    def __init__(self, config: RandomizeConfig | None, env: "Env[Any]", first: int, seed: int) -> None:
        config = config or UNDISTURBED
        self._env, self._first = env, first
        self.generator = torch.Generator(device=env.device)
        self.seed(seed)
        layout = _layout(config, env)
        self._layout_size = len(layout)
        measured = [column for column, entry in enumerate(layout) if not entry.remembered]
        names = [layout[column].name for column in measured]
        self._measured = None if len(measured) == len(layout) else torch.tensor(measured, device=env.device)
        self._noise = EntryErrors("observation_noise", config.observation_noise, names, env.device)
        self._bias = EntryErrors("observation_bias", config.observation_bias, names, env.device)
        self._encoders = EncoderErrors(config.encoder_bias, env.model, names, env.device)
        self._observation_delay, self._control_delay = config.observation_delay, config.control_delay
        self._substep_delay = config.control_delay_substeps
        if _most(self._substep_delay) >= env.sim.substeps:
            raise ConfigError(
                f"physics.randomize.control_delay_substeps: an env step has {env.sim.substeps} substeps, so write at "
                f"most {env.sim.substeps - 1}, and whole env steps in control_delay"
            )
        self._kicks = None if config.push is None else _Kicks(config.push, env)
        widths = {
            "noise": int(self._noise.size > 0),
            "bias": self._bias.size,
            "encoders": self._encoders.size,
            "observation_delay": int(self._observation_delay is not None),
            "control_delay": int(self._control_delay is not None),
            "control_delay_substeps": int(self._substep_delay is not None),
            "push": 0 if self._kicks is None else self._kicks.size,
        }
        self.size = sum(widths.values())
        self._measured_count = len(names)
        self.disturbs_observations = bool(names)
        self._widths = widths

    def seed(self, seed: int) -> None:
        """Restart the generator as if constructed with this seed."""
        seed_stream(self.generator, seed, _STREAM)

    def draw(self, count: int) -> Tensor:
        """Numbers of `count` episodes, uniform in [0, 1), (count, D)."""
        return torch.rand((count, self.size), generator=self.generator, device=self._env.device)

    def memories(self) -> dict[str, Memory]:
        """The memories that delays need; gradients flow through late observations and controls."""
        sizes = {
            _OBSERVATIONS: _most(self._observation_delay) * self._measured_count,
            _CONTROLS: (_most(self._control_delay) + (self._substep_delay is not None)) * self._env.model.nu,
        }
        delayed = {name: Memory(size, gradient=True) for name, size in sizes.items() if size}
        return {**delayed, _STEPS: Memory(1)} if delayed else {}

    def remember(self, before: EnvState, action: Tensor) -> dict[str, Tensor]:
        """The values of `memories` after a step by `action` from `before`, the current state of the environment."""
        env, memory = self._env, before.memory
        newest: dict[str, Tensor] = {}
        if _OBSERVATIONS in memory:
            newest[_OBSERVATIONS] = self._measured_of(env.observe(before.physics, before.action))
        if _CONTROLS in memory:
            newest[_CONTROLS] = env.control(action)
        if not newest:
            return {}
        delayed = {name: torch.cat((new, memory[name][:, : -new.shape[1]]), dim=-1) for name, new in newest.items()}
        return {**delayed, _STEPS: memory[_STEPS] + 1.0}

    def pushed(self, physics: StepState, state: EnvState) -> StepState:
        """`physics` as the step from `state` begins with it: after a kick where it is time for one."""
        if self._kicks is None:
            return physics
        return self._kicks.applied(physics, state.age, self._numbers(state, "push"))

    def control(self, control: Tensor, state: EnvState) -> Tensor:
        """The controls that reach the actuators in the step from `state` when `control` (W, nu) is sent.

        Returns:
            (W, nu), or (S, W, nu) for each of S substeps if controls may be late by substeps.
        """
        if self._substep_delay is None:
            return self._arrived(control, state)
        late = self._drawn(self._substep_delay, state, "control_delay_substeps")
        return torch.stack([self._arrived(control, state, late > k) for k in range(self._env.sim.substeps)])

    def _arrived(self, control: Tensor, state: EnvState, on_its_way: Tensor | None = None) -> Tensor:
        """Controls (W, nu) that have reached the actuators.

        Args:
            control: the newest controls, (W, nu).
            state: state in which they were sent.
            on_its_way: worlds in which they are one env step later than `control_delay` says, (W,) bool; None: none.
        """
        if self._control_delay is not None or on_its_way is not None:
            late = self._drawn(self._control_delay, state, "control_delay")
            late = late if on_its_way is None else late + on_its_way
            control = _of_earlier(control, state.memory.get(_CONTROLS), self._possible(late, state))
        if self._encoders.size:
            control = self._encoders.shifted(control, self._numbers(state, "encoders"))
        return control

    def observation(self, obs: Tensor, state: EnvState) -> Tensor:
        """What the policy is given (W, O) in `state`, which the environment observes as `obs`."""
        if self._layout_size and obs.shape[-1] != self._layout_size:
            raise ConfigError(
                f"observation_layout of {type(self._env).__qualname__} names {self._layout_size} entries of an "
                f"observation of {obs.shape[-1]}: name each"
            )
        if self._measured is None:
            return self._disturbed(obs, state)
        return obs.index_copy(1, self._measured, self._disturbed(self._measured_of(obs), state))

    def _measured_of(self, obs: Tensor) -> Tensor:
        """The measured entries (W, M) of observations (W, O)."""
        return obs if self._measured is None else obs.index_select(1, self._measured)

    def _disturbed(self, obs: Tensor, state: EnvState) -> Tensor:
        """Measured entries (W, M) with their delay and errors."""
        age = state.age
        if self._observation_delay is not None:
            late = self._possible(self._drawn(self._observation_delay, state, "observation_delay"), state)
            obs = _of_earlier(obs, state.memory.get(_OBSERVATIONS), late)
            age = age - late
        if self._bias.size:
            obs = self._bias.added(obs, self._numbers(state, "bias"))
        if self._encoders.size:
            obs = self._encoders.added(obs, self._numbers(state, "encoders"))
        if self._noise.size:
            # A late observation keeps the noise of the step in which it was made.
            obs = self._noise.added(obs, uniform_hash(self._numbers(state, "noise")[:, 0], age, self._noise.size))
        return obs

    def _drawn(self, delay: tuple[int, int] | None, state: EnvState, name: str) -> Tensor:
        """The delay of each world's episode in the units of the setting, (W,) int64."""
        if delay is None or not delay[1]:
            return torch.zeros_like(state.age)
        fewest, most = delay
        return fewest + (self._numbers(state, name)[:, 0] * (most - fewest + 1)).long()

    def _possible(self, late: Tensor, state: EnvState) -> Tensor:
        """Delays [env steps], (W,) int64, limited to the age of the memory: nothing is older than its episode."""
        remembered_steps = state.memory.get(_STEPS)
        return late if remembered_steps is None else torch.minimum(late, remembered_steps[:, 0].long())

    def _numbers(self, state: EnvState, name: str) -> Tensor:
        """The numbers (W, n) drawn for the disturbance of this name."""
        drawn = state.numbers[:, self._first : self._first + self.size]
        return drawn.split(list(self._widths.values()), dim=-1)[list(self._widths).index(name)]


class _Kicks:
    """Kicks: when each comes and how large it is are drawn like a command that changes within an episode."""

    def __init__(self, push: Push, env: "Env[Any]") -> None:
        self._step_s = env.config.control_timestep
        dofs = dict(_kicked_dofs(push, env.model))
        times = math.ceil(env.config.episode_length * self._step_s / push.every[0])
        self.size = times * (len(dofs) + 1)
        self._draws = Draws(slice(0, self.size), times, push.every)
        self._dofs = torch.tensor(list(dofs), dtype=torch.int64, device=env.device)
        largest = torch.tensor(list(dofs.values()), device=env.device)
        self._ranges = torch.stack((-largest, largest))

    def applied(self, state: StepState, age: Tensor, drawn: Tensor) -> StepState:
        """The state at an age [env steps], (W,), after its kick, if any, from the drawn numbers (W, size)."""
        before, now = ((steps * self._step_s) for steps in (age - 1, age))
        begins = self._draws.times_drawn(drawn, now) > self._draws.times_drawn(drawn, before)
        kick = self._draws.value(drawn, now, self._ranges) * begins[:, None]
        return state._replace(qvel=state.qvel.index_add(1, self._dofs, kick))


def uniform_hash(seed: Tensor, step: Tensor, count: int) -> Tensor:
    """Uniform numbers in [0, 1), (W, count): hashes of a seed, a step and the column.

    The hash function is `lowbias32` of https://github.com/skeeto/hash-prospector.

    Args:
        seed: in [0, 1), (W,).
        step: (W,) int64.
        count: number of columns.
    """
    columns = torch.arange(count, device=seed.device)
    row = _hash(_hash((seed * 2.0**UNIFORM_BITS).long()) + step)
    return (_hash(row[:, None] + _hash(columns)) >> (32 - UNIFORM_BITS)) * 2.0**-UNIFORM_BITS


def _hash(values: Tensor) -> Tensor:
    """Hashes in [0, 2³²) of the low 32 bits of int64 values."""
    values = values & _LOW_HALF
    values = ((values ^ (values >> 16)) * 0x7FEB352D) & _LOW_HALF
    values = ((values ^ (values >> 15)) * 0x846CA68B) & _LOW_HALF
    return values ^ (values >> 16)


def _most(delay: tuple[int, int] | None) -> int:
    """The longest delay of a setting."""
    return 0 if delay is None else delay[1]


def _of_earlier(current: Tensor, earlier: Tensor | None, late: Tensor) -> Tensor:
    """The values (W, n) of `late` env steps ago in each world.

    Args:
        current: the current values, (W, n).
        earlier: the values of k earlier steps, newest first, (W, k n); None: there are none.
        late: delays from 0 to k [env steps], (W,).
    """
    if earlier is None:
        return current
    chosen = current
    for steps, values in enumerate(earlier.split(current.shape[1], dim=1), start=1):
        chosen = torch.where((late == steps)[:, None], values, chosen)
    return chosen


def _layout(config: RandomizeConfig, env: "Env[Any]") -> list[Entry]:
    """All entries of the observation; none if no setting needs their names.

    Raises:
        ConfigError: a setting needs them, and the environment does not name them.
    """
    observed = ("observation_noise", "observation_bias", "encoder_bias", "observation_delay")
    needing = [name for name in observed if getattr(config, name) is not None]
    if not needing:
        return []
    layout = env.observation_layout()
    if layout is None:
        raise ConfigError(
            f"physics.randomize.{needing[0]}: {type(env).__qualname__} does not name the entries of its observation: "
            "write its method observation_layout"
        )
    return layout


def _kicked_dofs(push: Push, model: mujoco.MjModel) -> Iterator[tuple[int, float]]:
    """Numbers of the degrees of freedom that are kicked, and the largest change of the velocity of each.

    Raises:
        ConfigError: the model has no such joint, or the joint has another number of velocities.
    """
    key, joints = "physics.randomize.push.velocity", [model.joint(i).name or str(i) for i in range(model.njnt)]
    for name, largest in push.velocity.items():
        if name not in joints:
            raise ConfigError(f"{key}: the model has no joint {name!r}; it has {', '.join(joints) or 'none'}")
        joint = joints.index(name)
        first = int(model.jnt_dofadr[joint])
        size = int((model.dof_jntid == joint).sum())
        if len(largest) != size:
            raise ConfigError(
                f"{key}.{name}: write {size} numbers, one for each velocity of the joint, not {len(largest)}"
            )
        yield from zip(range(first, first + size), largest, strict=True)
