"""What an exported policy has to remember from call to call, found from the environment's methods.

`PolicyToControl.forward` in `export/network.py` does the carrying.

A memory is carried by the file where `remember` gives a matrix product of the memories before, the entries of the
observation and the action: last actions, filters, delay lines, histories of what was observed before. Entries of the
observation that are a matrix product of carried memories are filled in by the file. All other entries are inputs.

Axes: N rows, O observation, A action, M numbers of memories.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from msk_ray.envs import Env, EnvState
from msk_ray.step import StepState

NOISE = 0.1
"""Standard deviation of what is added to initial states, so that no two are equal."""
_TOLERANCE = 1e-5
"""Largest error of a matrix product, divided by the largest magnitude of what it gives if that is above 1."""
_ROUNDING = 1e-6
"""Coefficients below it are 0, in units of the spread of what they multiply."""


class Affine(NamedTuple):
    """Rows (N, k) to rows (N, m): x · matrix + offset."""

    matrix: Tensor
    offset: Tensor

    def __call__(self, rows: Tensor) -> Tensor:
        return rows @ self.matrix + self.offset


@dataclass(frozen=True)
class CarriedMemory:
    """What passes from one call of an exported policy to the next."""

    start: Mapping[str, Tensor]
    """Values in the first call of an episode, (size,), by name."""
    given: Sequence[int]
    """Places in the observation of the entries that are inputs."""
    shown: Sequence[int]
    """Places of those that show carried memories."""
    fill: Affine
    """Memories to shown entries."""
    update: Affine
    """Memories, given entries and action, in one row, to the memories after the call."""
    outside: Sequence[str]
    """Memories that given entries depend on."""


@torch.no_grad()
def carried_memory(env: Env[Any], read_by_control: set[str]) -> CarriedMemory:
    """What a policy carries in this environment, where the controls read these memories."""
    samples = _Samples(env)
    carried = [name for name, starts in samples.starts.items() if bool((starts == starts[0]).all())]
    while lost := samples.not_updated(carried):
        carried = [name for name in carried if name not in lost]
    shown, _ = samples.fill(carried)
    needed = read_by_control | {name for name in carried if samples.observed[name][shown].any()}
    while more := samples.sources(needed, carried) - needed:
        needed |= more
    carried = [name for name in carried if name in needed]
    shown, fill = samples.fill(carried)
    given = samples.others(shown)
    return CarriedMemory(
        {name: samples.starts[name][0] for name in carried},
        given,
        shown,
        fill,
        samples.update(carried, given)[0],
        [name for name, columns in samples.observed.items() if columns[given].any()],
    )


class _Round(NamedTuple):
    """A row for each world; memories by name, (W, size)."""

    start: Mapping[str, Tensor]
    before: Mapping[str, Tensor]
    obs: Tensor
    changed: Mapping[str, Tensor]
    """Entries of the observation that another value of a memory changes, (W, O) bool."""
    action: Tensor
    after: Mapping[str, Tensor]


class _Samples:
    """What an environment's methods give for random states, memories and actions, all independent of each other.

    Attributes:
        starts: memories at the start of episodes, (N, size), by name.
        observed: entries of the observation that change with a memory, (O,) bool, by name.
    """

    def __init__(self, env: Env[Any]) -> None:
        self._env = env
        self._sizes = {name: values.shape[1] for name, values in env.memory.items()}
        unknowns = sum(self._sizes.values()) + env.obs_size + env.action_size + 1
        self._generator = torch.Generator().manual_seed(0)
        self.starts: dict[str, Tensor] = {}
        self.observed: dict[str, Tensor] = {}
        if not self._sizes:
            return
        with _undisturbed(env):
            rounds = [self._round() for _ in range(-(-2 * unknowns // env.nworld))]
        self._before = _stacked([one.before for one in rounds])
        self._after = _stacked([one.after for one in rounds])
        self.starts = _stacked([one.start for one in rounds])
        self.observed = {name: rows.any(0) for name, rows in _stacked([one.changed for one in rounds]).items()}
        self._obs = torch.cat([one.obs for one in rounds])
        self._action = torch.cat([one.action for one in rounds])

    def _round(self) -> "_Round":
        env, state = self._env, self._env.reset_state()
        start = state.memory
        before = {name: self._normal(values) for name, values in start.items()}
        previous, action = (self._normal(state.action).clamp(-1.0, 1.0) for _ in range(2))
        age = torch.randint(env.config.episode_length, state.age.shape, generator=self._generator)
        state = state._replace(
            physics=self._varied(state.physics), action=previous, age=age.to(state.age), memory=before
        )
        obs = self._observed(state)
        changed = {}
        for name, values in before.items():
            other = state._replace(memory={**before, name: self._normal(values)})
            changed[name] = self._observed(other) != obs
        with env.in_state(state):
            after = env.remember(self._varied(state.physics), action)
        return _Round(start, before, obs, changed, action, after)

    def _observed(self, state: EnvState) -> Tensor:
        drawn = self._env.generator.get_state()
        obs = self._env.observation_of(state)
        self._env.generator.set_state(drawn)
        return obs

    def _normal(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=self._generator).to(like)

    def _varied(self, physics: StepState) -> StepState:
        return StepState(*(part + NOISE * self._normal(part) for part in physics))

    def others(self, columns: Sequence[int]) -> list[int]:
        """The other entries of the observation."""
        return [column for column in range(self._env.obs_size) if column not in set(columns)]

    def fill(self, carried: Sequence[str]) -> tuple[list[int], Affine]:
        """Entries of the observation that carried memories give alone, and how."""
        columns = [c for c in range(self._env.obs_size) if any(bool(self.observed[name][c]) for name in carried)]
        if not columns:
            return [], Affine(torch.zeros(0, 0), torch.zeros(0))
        product, exact = _fitted(self._row(carried), self._obs[:, columns])
        kept = exact.nonzero()[:, 0]
        return [columns[k] for k in kept], Affine(product.matrix[:, kept], product.offset[kept])

    def update(self, carried: Sequence[str], given: Sequence[int]) -> tuple[Affine, Tensor]:
        """Memories after the action, and which of their numbers (M,) follow from what a call is given."""
        if not carried:
            return Affine(torch.zeros(0, 0), torch.zeros(0)), torch.zeros(0, dtype=torch.bool)
        inputs = torch.cat((self._row(carried), self._obs[:, list(given)], self._action), -1)
        return _fitted(inputs, torch.cat([self._after[name] for name in carried], -1))

    def not_updated(self, carried: Sequence[str]) -> set[str]:
        """Memories that do not follow from what a call is given, if these are carried."""
        _, exact = self.update(carried, self.others(self.fill(carried)[0]))
        parts = exact.split([self._sizes[name] for name in carried])
        return {name for name, part in zip(carried, parts, strict=True) if not bool(part.all())}

    def sources(self, names: set[str], carried: Sequence[str]) -> set[str]:
        """Memories that these, as far as they are carried, follow from."""
        product, _ = self.update(carried, self.others(self.fill(carried)[0]))
        sizes = [self._sizes[name] for name in carried]
        columns = dict(zip(carried, product.matrix.split(sizes, 1) if carried else (), strict=True))
        found = set()
        for name in names & set(carried):
            rows = columns[name][: sum(sizes)].split(sizes)
            found |= {source for source, row in zip(carried, rows, strict=True) if row.any()}
        return found

    def _row(self, names: Sequence[str]) -> Tensor:
        return torch.cat([self._before[name] for name in names], -1)


@contextmanager
def _undisturbed(env: Env[Any]) -> Iterator[None]:
    """Methods of the environment may be called inside; it is then as before."""
    drawn, state = env.generator.get_state(), env.state
    env.measurements.ignore_contact_forces = True  # no step leads to the states tried
    try:
        yield
    finally:
        env.measurements.ignore_contact_forces = False
        env.generator.set_state(drawn)
        env.state = state
        env.release_graph()


def _stacked(rounds: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    return {name: torch.cat([rows[name] for rows in rounds]) for name in rounds[0]}


def _fitted(inputs: Tensor, outputs: Tensor) -> tuple[Affine, Tensor]:
    """The matrix product from inputs (N, k) to outputs (N, m) with the least squared error, and which outputs (m,) it
    gives exactly."""
    inputs, outputs = inputs.double(), outputs.double()
    rows = torch.cat((inputs, torch.ones_like(inputs[:, :1])), -1)
    solution = torch.linalg.lstsq(rows, outputs, driver="gelsd").solution
    error = (rows @ solution - outputs).abs().amax(0) / outputs.abs().amax(0).clamp_min(1.0)
    spread = torch.cat((inputs.std(0), torch.ones(1, dtype=torch.float64)))
    solution = solution.masked_fill((solution * spread[:, None]).abs() < _ROUNDING, 0.0).float()
    return Affine(solution[:-1], solution[-1]), error < _TOLERANCE
