"""What episodes begin with: a physical state, and the numbers drawn for it.

Axes: W worlds, N episodes, K numbers by `physics.randomize`.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from msk_ray.envs.disturbances import Disturbances
from msk_ray.envs.randomize import Randomizer
from msk_ray.envs.records import Resets
from msk_ray.group import Group
from msk_ray.step import StepState


class Starts:
    """Draws what episodes begin with, and keeps it in stock for the next env steps.

    Args:
        draw: gives initial states of so many episodes, and the numbers of the task of each.
        sources: what draws the K numbers before those of the task, by name; None where nothing does.
        commands: how many numbers of the task, the last ones, are draws of commands.
        nworld: W.
    """

    def __init__(
        self,
        draw: Callable[[int], tuple[StepState, Tensor]],
        sources: Mapping[str, Randomizer | Disturbances | None],
        commands: int,
        nworld: int,
    ) -> None:
        self._sources = {name: source for name, source in sources.items() if source is not None and source.size}
        self._draw, self._commands, self._nworld = draw, commands, nworld
        self._stock: list[Resets] = []

    def draw(self, count: int) -> Resets:
        """What `count` episodes begin with."""
        physics, task = self._draw(count)
        drawn = [source.draw(count) for source in self._sources.values()]
        return Resets(physics, torch.cat((*drawn, task), dim=-1) if drawn else task)

    def draw_steps(self, steps: int, group: Group) -> Resets:
        """What the episodes that may begin in the next `steps` env steps begin with, one step after the other.

        Every process of the group draws for all worlds, and keeps what its own begin with.
        """
        worlds = self._nworld * group.size
        drawn = self.draw(steps * worlds)

        def own(values: Tensor) -> Tensor:
            return group.own(values.unflatten(0, (steps, worlds)), dim=1).flatten(0, 1)

        return Resets(StepState(*map(own, drawn.physics)), own(drawn.numbers))

    def stock(self, drawn: Resets | None) -> None:
        """Take from those drawn by `draw_steps` from now on; None: draw each when it is needed."""
        self._stock = []
        if drawn is not None:
            *physics, numbers = (t.split(self._nworld) for t in (*drawn.physics, drawn.numbers))
            self._stock = [Resets(StepState(*p), n) for *p, n in zip(*physics, numbers, strict=True)]

    def take(self, group: Group) -> Resets:
        """What the episodes that may begin now begin with."""
        return self._stock.pop() if self._stock else self.draw_steps(1, group)

    def split(self, numbers: Tensor) -> dict[str, Tensor]:
        """The columns of `EnvState.numbers` of each source, of the `task`, and of the `commands`."""
        sizes = {name: source.size for name, source in self._sources.items()}
        sizes["task"] = numbers.shape[1] - sum(sizes.values()) - self._commands
        sizes["commands"] = self._commands
        return dict(zip(sizes, numbers.split(list(sizes.values()), dim=1), strict=True))

    def seed(self, seed: int) -> None:
        """Draw the K numbers from now on as after construction with this seed, the environment's."""
        for source in self._sources.values():
            source.seed(seed)

    def state_dict(self, numbers: Tensor, group: Group) -> dict[str, Any]:
        """The numbers of the worlds of all processes, and the generators of their sources."""
        parts = {name: group.gather(part).clone() for name, part in self.split(numbers).items()}
        task = torch.cat((parts["task"], parts["commands"]), dim=-1)
        sources = {
            name: {"numbers": parts[name], "generator": source.generator.get_state()}
            for name, source in self._sources.items()
        }
        return {"randomizer": None, **sources, **({"env_task": task} if task.shape[1] else {})}

    def load_state_dict(self, state: Mapping[str, Any], group: Group, device: torch.device) -> Tensor:
        """Continue from a `state_dict`. Returns the numbers of the worlds of this process."""
        numbers = [torch.zeros((self._nworld, 0), device=device)]
        for name, source in self._sources.items():
            numbers.append(group.own(state[name]["numbers"].to(device)))
            # The state of a generator is a host tensor on every device.
            source.generator.set_state(state[name]["generator"].cpu())
        if "env_task" in state:
            numbers.append(group.own(state["env_task"].to(device)))
        return torch.cat(numbers, dim=-1)
