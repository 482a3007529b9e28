"""Disturbances in training besides random parameters of the model: errors of observations (`observation_errors.py`),
delays of observations and controls (`delays.py`), and pushes (`pushes.py`).

All of them are functions of numbers drawn when an episode begins, of the episode's age, and of memories. A step draws
nothing, so the same state always gives the same observation.

Axes: W worlds, O observation, M measured entries of the observation (all but known ones), D numbers drawn for an
episode.
"""

from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from msk_ray.config import RandomizeConfig
from msk_ray.config.randomize import UNDISTURBED
from msk_ray.envs.delays import Delays
from msk_ray.envs.generators import seed_stream
from msk_ray.envs.layout import Entry
from msk_ray.envs.memory import Memory
from msk_ray.envs.observation_errors import UNIFORM_BITS, EncoderErrors, EntryErrors
from msk_ray.envs.pushes import Pushes
from msk_ray.envs.records import EnvState
from msk_ray.errors import ConfigError
from msk_ray.step import StepState

if TYPE_CHECKING:
    from msk_ray.envs.base import Env

_STREAM = 2
"""Number of the random stream, for `seed_stream`."""
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
        measured = [column for column, entry in enumerate(layout) if not entry.known]
        names = [layout[column].name for column in measured]
        self._measured = None if len(measured) == len(layout) else torch.tensor(measured, device=env.device)
        self._noise = EntryErrors("observation_noise", config.observation_noise, names, env.device)
        self._bias = EntryErrors("observation_bias", config.observation_bias, names, env.device)
        self._encoders = EncoderErrors(config.encoder_bias, env.model, names, env.device)
        self._delays = Delays(config, len(names), env.model.nu, env.sim.substeps)
        self._pushes = None if config.push is None else Pushes(config.push, env)
        widths = {
            "noise": int(self._noise.size > 0),
            "bias": self._bias.size,
            "encoders": self._encoders.size,
            **self._delays.widths,
            "push": 0 if self._pushes is None else self._pushes.size,
        }
        self.size = sum(widths.values())
        self.disturbs_observations = bool(names)
        self._widths = widths

    def seed(self, seed: int) -> None:
        """Restart the generator as if constructed with this seed."""
        seed_stream(self.generator, seed, _STREAM)

    def draw(self, count: int) -> Tensor:
        """Numbers of `count` episodes, uniform in [0, 1), (count, D)."""
        return torch.rand((count, self.size), generator=self.generator, device=self._env.device)

    def memories(self) -> dict[str, Memory]:
        """The memories that delays need."""
        return self._delays.memories()

    def remember(self, before: EnvState, action: Tensor) -> dict[str, Tensor]:
        """The values of `memories` after a step by `action` from `before`, the current state of the environment."""
        env = self._env
        return self._delays.remember(
            before.memory,
            lambda: self._measured_of(env.observe(before.physics, before.action)),
            lambda: env.control(action),
        )

    def pushed(self, physics: StepState, state: EnvState) -> StepState:
        """`physics` as the step from `state` begins with it: after a push where it is time for one."""
        if self._pushes is None:
            return physics
        return self._pushes.applied(physics, state.age, self._numbers(state, "push"))

    def control(self, control: Tensor, state: EnvState) -> Tensor:
        """The controls that act in the step from `state` when `control` (W, nu) is sent.

        Returns:
            (W, nu), or (S, W, nu) for each of S substeps if controls may be late by substeps.
        """
        arrived = self._delays.arrived(control, state, partial(self._numbers, state))
        if self._encoders.size:
            numbers = self._numbers(state, "encoders")
            arrived = [self._encoders.shifted(each, numbers) for each in arrived]
        return arrived[0] if len(arrived) == 1 else torch.stack(arrived)

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
        obs, age = self._delays.observed(obs, state, partial(self._numbers, state))
        if self._bias.size:
            obs = self._bias.added(obs, self._numbers(state, "bias"))
        if self._encoders.size:
            obs = self._encoders.added(obs, self._numbers(state, "encoders"))
        if self._noise.size:
            # A late observation keeps the noise of the step in which it was made.
            obs = self._noise.added(obs, uniform_hash(self._numbers(state, "noise")[:, 0], age, self._noise.size))
        return obs

    def _numbers(self, state: EnvState, name: str) -> Tensor:
        """The numbers (W, n) drawn for the disturbance of this name."""
        drawn = state.numbers[:, self._first : self._first + self.size]
        return drawn.split(list(self._widths.values()), dim=-1)[list(self._widths).index(name)]


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
