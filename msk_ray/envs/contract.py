"""What the methods of an environment's class must give, and how it is said where one gives something else.

Checks look at shapes, types and versions of tensors only, never at their contents, so that no host waits for a device,
and a recorded epoch is as it would be without them. `rehearsal` makes all of them once, `Env.step` some in every step.

Axes: W worlds, O observation, A action, T reward terms.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from msk_ray.envs.generators import GlobalGenerators
from msk_ray.envs.hints import described
from msk_ray.envs.memory import Memory
from msk_ray.errors import ConfigError, MskRayError
from msk_ray.step import StepState
from msk_ray.step.autograd.out_of_memory import is_out_of_memory

if TYPE_CHECKING:
    from msk_ray.envs.base import Env

Given = Tensor | StepState | Mapping[str, Tensor]
"""What a method is given: observation or action, a physical state, or memories."""


class Contract:
    """What one environment's methods must give.

    Args:
        env: the environment; it need not be complete yet.

    Attributes:
        name: of its class.
    """

    def __init__(self, env: "Env[Any]") -> None:
        self._env = env
        self.name = type(env).__qualname__
        self._generators = GlobalGenerators(env.device)

    @contextmanager
    def during(self, method: str) -> Iterator[None]:
        """Say in one line what goes wrong in a method, and which one it is.

        Raises:
            ConfigError: it raises an exception that is not for the user yet, or draws from a global generator.
        """
        before = self._generators.state()
        try:
            yield
        except MskRayError:
            raise
        except Exception as error:
            if is_out_of_memory(error):
                raise
            raise ConfigError(f"{method} of {self.name}: {described(error, self._env)}") from error
        if (drawn := self._generators.changed(before)) is not None:
            raise ConfigError(
                f"{method} of {self.name} draws from {drawn}, so that scores would not repeat: draw with "
                "self.uniform(...) or self.normal(...)"
            )

    def call(self, method: str, call: Callable[[], Any], *given: Given) -> Any:
        """What a method gives, which must leave the tensors that it is given as they are.

        Raises:
            ConfigError: it does not, or as for `during`.
        """
        before = versions(*given)
        with self.during(method):
            result = call()
        self.check_unchanged(method, before, *given)
        return result

    def check_unchanged(self, method: str, before: Sequence[int], *given: Given) -> None:
        """Raise ConfigError if the tensors given to methods have other `versions` than before."""
        for (name, tensor), version in zip(_named(given), before, strict=True):
            if tensor._version != version:
                raise ConfigError(
                    f"{method} of {self.name} changes {name} in place: write to a copy, such as {name}.clone()"
                )

    def check_results(self, obs: Any, terms: Any, fell: Any) -> None:
        """Raise ConfigError if what a step's methods gave is not of the right kind, shape and type."""
        env = self._env
        self.check_width("observe", obs, env.obs_size)
        wanted = (env.nworld, len(env.reward_names))
        if isinstance(terms, Tensor) and terms.shape != wanted:
            raise ConfigError(
                f"reward_terms of {self.name} has shape {tuple(terms.shape)}, but reward_names has {wanted[1]} names "
                f"for {env.nworld} worlds: return torch.stack(terms, dim=-1)"
            )
        self.check("reward_terms", terms, wanted, "torch.stack(terms, dim=-1)")
        self.check("fell", fell, (env.nworld,), "a comparison, such as height < 0.5", torch.bool)

    def check_width(self, method: str, obs: Any, width: int) -> None:
        """Raise ConfigError if an observation is none, or has another number of entries than before."""
        self.check_observation(method, obs)
        if obs.shape[-1] != width:
            raise ConfigError(
                f"{method} of {self.name} has {obs.shape[-1]} entries, but {width} before: the number of entries must "
                "stay the same"
            )

    def check_observation(self, method: str, obs: Any) -> None:
        """Raise ConfigError if an observation is none."""
        worlds = self._env.nworld
        if isinstance(obs, Tensor) and (obs.dim() != 2 or len(obs) != worlds):
            raise ConfigError(
                f"{method} of {self.name} has shape {tuple(obs.shape)}, not (worlds, entries) with {worlds} worlds"
            )
        self.check(method, obs, None, "torch.cat((state.qpos, state.qvel), dim=-1), for one")

    @property
    def start(self) -> str:
        """The method that gives initial states."""
        return "draw_start" if self._env.overrides("draw_start") else "draw_physics"

    def check_state(self, method: str, state: Any, count: int) -> None:
        """Raise ConfigError if a method gives no physical state of `count` worlds."""
        model = self._env.model
        if not isinstance(state, StepState):
            raise ConfigError(f"{method} of {self.name} returns {kind_of(state)}: return StepState(qpos, qvel, act)")
        for name, part, size in zip(StepState._fields, state, (model.nq, model.nv, model.na), strict=True):
            self.check(f"{name} from {method}", part, (count, size))

    def check_declared(self, declared: Any) -> None:
        """Raise ConfigError if `memories` gives no declarations."""
        if not isinstance(declared, Mapping):
            raise ConfigError(f"memories of {self.name} returns {kind_of(declared)}: return a dict of Memory by name")
        for name, memory in declared.items():
            if not isinstance(memory, Memory) or memory.size < 1:
                raise ConfigError(
                    f"{name!r} in memories of {self.name} is {memory!r}: write Memory(size), with the numbers that "
                    "each world remembers"
                )

    def check_memory(self, method: str, values: Any, like: Mapping[str, Tensor], *, complete: bool = True) -> None:
        """Raise ConfigError if a method gives memories that are not like these, or, if `complete`, not all of them."""
        if not isinstance(values, Mapping):
            raise ConfigError(f"{method} of {self.name} returns {kind_of(values)}: return a dict of tensors by name")
        for name, value in values.items():
            if name not in like:
                raise ConfigError(f"{method} of {self.name} gives {name!r}, which its memories lack: declare it there")
            self.check(f"{name!r} from {method}", value, tuple(like[name].shape))
        if complete and (missing := [name for name in like if name not in values]):
            raise ConfigError(
                f"{method} of {self.name} gives no {missing[0]!r}: give every memory, an unchanged one as "
                f"self.memory[{missing[0]!r}]"
            )

    def check(
        self,
        method: str,
        value: Any,
        shape: tuple[int, ...] | None,
        example: str = "one row for each world",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Raise ConfigError if a result is no tensor of this shape and type on the environment's device."""
        who, device = f"{method} of {self.name}", self._env.device
        if value is None:
            raise ConfigError(f"{who} returns nothing: end it with `return`, and {example}")
        if not isinstance(value, Tensor):
            raise ConfigError(
                f"{who} returns {kind_of(value)}, not a tensor: compute it with torch, and return {example}"
            )
        if shape is not None and value.shape != shape:
            raise ConfigError(f"{who} has shape {tuple(value.shape)}, not {shape}: return {example}")
        if value.dtype != dtype:
            instead = example if dtype is torch.bool else "write .float(), and make constants with dtype=torch.float32"
            raise ConfigError(f"{who} returns {value.dtype}, not {dtype}: {instead}")
        if value.device != device:
            raise ConfigError(f"{who} is on {value.device}, not {device}: make constants with device=self.device")


def versions(*given: Given) -> list[int]:
    """How often each of some tensors has been changed in place."""
    return [tensor._version for _, tensor in _named(given)]


def _named(given: Sequence[Given]) -> list[tuple[str, Tensor]]:
    """The tensors among what methods are given, by the names that they have there."""
    names = iter(("action", "obs"))
    tensors: list[tuple[str, Tensor]] = []
    for value in given:
        if isinstance(value, StepState):
            tensors += [(f"state.{name}", part) for name, part in value._asdict().items()]
        elif isinstance(value, Mapping):
            tensors += [(f"self.memory[{name!r}]", part) for name, part in value.items()]
        else:
            tensors.append((next(names), value))
    return tensors


def kind_of(value: Any) -> str:
    """What a value is, with an article."""
    name = type(value).__name__
    return "a numpy array" if name == "ndarray" else f"{'an' if name[0] in 'aeiou' else 'a'} {name}"
