"""Delays of observations and controls in training.

What is on its way is kept in memories (`memory.py`), newest first, which begin anew with each episode: `Memories.begun`
resets them. How late it is, is drawn once an episode.

Axes: W worlds, M measured entries of the observation, S substeps.
"""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from msk_ray.config import RandomizeConfig
from msk_ray.envs.memory import Memory
from msk_ray.envs.records import EnvState
from msk_ray.errors import ConfigError

_OBSERVATIONS, _CONTROLS, _STEPS = "earlier observations", "earlier controls", "earlier steps"
"""Names of memories: observations and controls of earlier env steps, newest first, and the number of these steps."""

Numbers = Callable[[str], Tensor]
"""Gives the numbers (W, n), uniform in [0, 1), that an episode has drawn under a name of `Delays.widths`."""


class Delays:
    """The delays of a `randomize` section.

    Args:
        config: the section.
        measured: number of measured entries of the observation, M.
        controls: number of controls, nu.
        substeps: number of substeps of an env step, S.

    Attributes:
        widths: count of the numbers of an episode that each delay needs, by the name of its setting.

    Raises:
        ConfigError: controls are late by more substeps than an env step has.
    """

    def __init__(self, config: RandomizeConfig, measured: int, controls: int, substeps: int) -> None:
        self._observation, self._control = config.observation_delay, config.control_delay
        self._substep = config.control_delay_substeps
        if _most(self._substep) >= substeps:
            raise ConfigError(
                f"physics.randomize.control_delay_substeps: an env step has {substeps} substeps, so write at most "
                f"{substeps - 1}, and whole env steps in control_delay"
            )
        self._measured, self._controls, self._substeps = measured, controls, substeps
        self.widths = {
            "observation_delay": int(self._observation is not None),
            "control_delay": int(self._control is not None),
            "control_delay_substeps": int(self._substep is not None),
        }

    def memories(self) -> dict[str, Memory]:
        """The memories of what is on its way; gradients flow through late observations and controls."""
        sizes = {
            _OBSERVATIONS: _most(self._observation) * self._measured,
            _CONTROLS: (_most(self._control) + (self._substep is not None)) * self._controls,
        }
        delayed = {name: Memory(size, gradient=True) for name, size in sizes.items() if size}
        return {**delayed, _STEPS: Memory(1)} if delayed else {}

    def remember(
        self, memory: Mapping[str, Tensor], observed: Callable[[], Tensor], sent: Callable[[], Tensor]
    ) -> dict[str, Tensor]:
        """The values of `memories` after a step.

        Args:
            memory: their values before it.
            observed: gives the measured entries at its start, (W, M).
            sent: gives the controls that it sends, (W, nu).
        """
        newest = {name: of() for name, of in ((_OBSERVATIONS, observed), (_CONTROLS, sent)) if name in memory}
        if not newest:
            return {}
        delayed = {name: torch.cat((new, memory[name][:, : -new.shape[1]]), dim=-1) for name, new in newest.items()}
        return {**delayed, _STEPS: memory[_STEPS] + 1.0}

    def observed(self, obs: Tensor, state: EnvState, numbers: Numbers) -> tuple[Tensor, Tensor]:
        """The measured entries (W, M) that have arrived in `state`, of which `obs` are the newest, and the ages (W,)
        [env steps] of the episodes when they were measured."""
        if self._observation is None:
            return obs, state.age
        late = self._possible(_drawn(self._observation, state, numbers, "observation_delay"), state)
        return _of_earlier(obs, state.memory.get(_OBSERVATIONS), late), state.age - late

    def arrived(self, control: Tensor, state: EnvState, numbers: Numbers) -> list[Tensor]:
        """The controls (W, nu) that have arrived at the actuators in the step from `state`, in which `control` is sent.

        Returns:
            One for all substeps, or S, one for each, if controls may be late by substeps.
        """
        if self._control is None and self._substep is None:
            return [control]
        whole = _drawn(self._control, state, numbers, "control_delay")
        delays = [whole]
        if self._substep is not None:
            part = _drawn(self._substep, state, numbers, "control_delay_substeps")
            delays = [whole + (part > k) for k in range(self._substeps)]
        earlier = state.memory.get(_CONTROLS)
        return [_of_earlier(control, earlier, self._possible(late, state)) for late in delays]

    @staticmethod
    def _possible(late: Tensor, state: EnvState) -> Tensor:
        """Delays [env steps], (W,) int64, limited to the age of the memory: nothing is older than its episode."""
        remembered_steps = state.memory.get(_STEPS)
        return late if remembered_steps is None else torch.minimum(late, remembered_steps[:, 0].long())


def _drawn(delay: tuple[int, int] | None, state: EnvState, numbers: Numbers, name: str) -> Tensor:
    """The delay of each world's episode in the units of the setting, (W,) int64."""
    if delay is None or not delay[1]:
        return torch.zeros_like(state.age)
    fewest, most = delay
    return fewest + (numbers(name)[:, 0] * (most - fewest + 1)).long()


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
