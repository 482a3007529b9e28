"""What the methods of an environment's class must give, and how it is said where one gives something else.

`Contract.rehearse` calls each method once, when the environment is made; what its results look like is checked after
every step too. That looks at shapes, types and versions of tensors only, never at their contents, so that no host waits
for a device, and a recorded epoch is as it would be without it.

Axes: W worlds, O observation, A action, T reward terms.
"""

import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from msk_ray.config import Reward, Term
from msk_ray.envs.generators import GlobalGenerators
from msk_ray.envs.memory import Memory
from msk_ray.envs.records import EnvState
from msk_ray.envs.terms import terms_without_gradient
from msk_ray.errors import ConfigError, MskRayError, shortened
from msk_ray.step import StepState
from msk_ray.step.autograd.out_of_memory import is_out_of_memory

if TYPE_CHECKING:
    from msk_ray.envs.base import Env

Given = Tensor | StepState | Mapping[str, Tensor]
"""What a method is given: observation or action, a physical state, or memories."""

_BASE = "msk_ray.envs.base"
_PACKAGE = Path(__file__).resolve().parents[1]
_HINTS = {
    "numpy() on Tensor": "compute it with torch: numpy cuts gradients",
    "convert": "return what torch computes, without .numpy() and .item()",
    "same device": "make constants once, in `prepare`, with device=self.device",
    "dtype": "make constants with dtype=torch.float32: an array of numpy becomes float64",
    "inplace": "write to a copy, such as state.qpos.clone()",
    "in-place": "write to a copy, such as state.qpos.clone()",
}
"""What to write instead, by what an exception's message contains."""


class Contract:
    """What one environment's methods must give.

    Args:
        env: the environment; it need not be complete yet.
    """

    def __init__(self, env: "Env[Any]") -> None:
        self._env = env
        self._name = type(env).__qualname__
        self._generators = GlobalGenerators(env.device)

    def begin(self) -> None:
        """Prepare the environment, draw the initial states of its worlds, and rehearse.

        Raises:
            ConfigError: as for `rehearse`.
        """
        with self.during("prepare"):
            self._env.prepare()
        with self.during(self.start):
            self._env.stock_resets(self._env.draw_resets(1))
        with self.during("begin_memory"):
            self._env.state = self._env.reset_state()
        self.rehearse()

    def rehearse(self) -> None:
        """Call every method once, in the initial state, and check what it gives; take `obs_size` from the observation
        where the class does not set it. Nothing that is drawn later changes.

        Raises:
            ConfigError: a method raises an exception, gives something of another kind, shape or type than it must,
                changes what it is given, or draws from a generator that does not repeat.
        """
        env = self._env
        drawn, before = env.generator.get_state(), env.state
        differentiable = env.sim.backward is not None
        self._check_names()
        try:
            with torch.set_grad_enabled(differentiable):
                self._rehearse(before, differentiable)
        finally:
            env.generator.set_state(drawn)
            env.state, env.ignore_contact_forces = before, False
            env.release_graph()

    def _rehearse(self, state: EnvState, differentiable: bool) -> None:
        env = self._env

        def copy(values: Tensor) -> Tensor:
            # No leaf, which torch would not let anything write to: that is for this check to say.
            return values.detach().clone().requires_grad_(differentiable).clone()

        action = copy(torch.zeros_like(state.action))
        first = self.call("observe", env.observation, state.physics, state.action)
        self._check_observation("observe", first)
        self._check_size(first)
        env.critic_size = env.obs_size
        if env.asymmetric:
            given = state.physics, state.action
            seen = self.call("observe_critic", lambda: env.observe_critic(*given), *given)
            self._check_observation("observe_critic", seen)
            env.critic_size = seen.shape[-1]
        moved = self.call("disturbed", lambda: env.disturbed(state.physics), state.physics)
        self._check_state("disturbed", moved, env.nworld)
        force = self.call("applied_force", lambda: env.applied_force(state.physics), state.physics)
        if force is not None:
            self._check("applied_force", force, (env.nworld, env.model.nv))
        controls = self.call("control", lambda: env.control(action), state.physics, action)
        self._check("control", controls, (env.nworld, env.model.nu), "one control for each actuator")
        after = StepState(*map(copy, state.physics))
        # No step has led to `after`, so that it has no contact forces.
        env.ignore_contact_forces = True
        remembered = self.call("remember", lambda: env.remembered(after, action), after, action, env.memory)
        self.check_memory("remember", remembered, env.memory)
        reached = env.reached(after, action)
        env.ignore_contact_forces = False
        obs = self.call("observe", lambda: env.observation_of(reached), after, action)
        if env.asymmetric:
            self.call("observe_critic", lambda: env.critic_observation_of(reached), after, action)
        env.ignore_contact_forces = True
        for term in env.active_terms:
            self._check_term(term, after, action, obs)
        terms = self.call("reward_terms", lambda: env.reward_terms(after, action, obs), after, action, obs)
        fell = self.call("fell", lambda: env.fell(after), after, action)
        self.check_results(obs, terms, fell)
        env.state = reached
        outcomes = self.call("outcome_terms", lambda: env.outcome_terms(after), after, action)
        self._check_outcomes(outcomes)
        if differentiable:
            self._warn_of_cut_terms(terms)

    def _check_term(self, term: Term, state: StepState, action: Tensor, obs: Tensor) -> None:
        what = f"term {term.name!r}"
        value = self.call(what, lambda: term.measure(self._env, state, action, obs), state, action, obs)
        self._check(what, value, (self._env.nworld,), "one number for each world")

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
            raise ConfigError(f"{method} of {self._name}: {self._described(error)}") from error
        if (drawn := self._generators.changed(before)) is not None:
            raise ConfigError(
                f"{method} of {self._name} draws from {drawn}, so that scores would not repeat: draw with "
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
                    f"{method} of {self._name} changes {name} in place: write to a copy, such as {name}.clone()"
                )

    def check_results(self, obs: Any, terms: Any, fell: Any) -> None:
        """Raise ConfigError if what a step's methods gave is not of the right kind, shape and type."""
        env = self._env
        self.check_width("observe", obs, env.obs_size)
        wanted = (env.nworld, len(env.reward_names))
        if isinstance(terms, Tensor) and terms.shape != wanted:
            raise ConfigError(
                f"reward_terms of {self._name} has shape {tuple(terms.shape)}, but reward_names has {wanted[1]} names "
                f"for {env.nworld} worlds: return torch.stack(terms, dim=-1)"
            )
        self._check("reward_terms", terms, wanted, "torch.stack(terms, dim=-1)")
        self._check("fell", fell, (env.nworld,), "a comparison, such as height < 0.5", torch.bool)

    def check_width(self, method: str, obs: Any, width: int) -> None:
        """Raise ConfigError if an observation is none, or has another number of entries than before."""
        self._check_observation(method, obs)
        if obs.shape[-1] != width:
            raise ConfigError(
                f"{method} of {self._name} has {obs.shape[-1]} entries, but {width} before: the number of entries must "
                "stay the same"
            )

    def _check_observation(self, method: str, obs: Any) -> None:
        worlds = self._env.nworld
        if isinstance(obs, Tensor) and (obs.dim() != 2 or len(obs) != worlds):
            raise ConfigError(
                f"{method} of {self._name} has shape {tuple(obs.shape)}, not (worlds, entries) with {worlds} worlds"
            )
        self._check(method, obs, None, "torch.cat((state.qpos, state.qvel), dim=-1), for one")

    def _check_size(self, obs: Tensor) -> None:
        width = obs.shape[-1]
        declared = getattr(self._env, "obs_size", width)
        if declared != width:
            raise ConfigError(
                f"observe of {self._name} has {width} entries, but its obs_size is {declared}: leave obs_size out"
            )
        self._env.obs_size = width

    def _check_names(self) -> None:
        if not self._env.terms and type(self._env).reward_terms.__module__ == _BASE:
            raise ConfigError(
                f"{self._name} has no reward: write terms = (Term(name, weight, function), ...) in the class, or "
                "reward_names and the method reward_terms"
            )
        names = getattr(self._env, "reward_names", None)
        right = isinstance(names, tuple | list) and all(isinstance(name, str) for name in names)
        if not right or len(set(names or ())) != len(names or ()):
            given = "has no reward_names" if names is None else f"has reward_names {names!r}"
            raise ConfigError(
                f"{self._name} {given}: write a tuple of different names, one for each term, such as "
                "reward_names = ('forward', 'effort')"
            )

    @property
    def start(self) -> str:
        """The method that gives initial states."""
        return "draw_physics" if type(self._env).draw_start.__module__ == _BASE else "draw_start"

    def check_start(self, state: Any, count: int) -> None:
        """Raise ConfigError if what `count` episodes begin with is no physical state of as many worlds."""
        self._check_state(self.start, state, count)

    def _check_state(self, method: str, state: Any, count: int) -> None:
        model = self._env.model
        if not isinstance(state, StepState):
            raise ConfigError(f"{method} of {self._name} returns {_kind(state)}: return StepState(qpos, qvel, act)")
        for name, part, size in zip(StepState._fields, state, (model.nq, model.nv, model.na), strict=True):
            self._check(f"{name} from {method}", part, (count, size))

    def check_declared(self, declared: Any) -> None:
        """Raise ConfigError if `memories` gives no declarations."""
        if not isinstance(declared, Mapping):
            raise ConfigError(f"memories of {self._name} returns {_kind(declared)}: return a dict of Memory by name")
        for name, memory in declared.items():
            if not isinstance(memory, Memory) or memory.size < 1:
                raise ConfigError(
                    f"{name!r} in memories of {self._name} is {memory!r}: write Memory(size), with the numbers that "
                    "each world remembers"
                )

    def check_memory(self, method: str, values: Any, like: Mapping[str, Tensor], *, complete: bool = True) -> None:
        """Raise ConfigError if a method gives memories that are not like these, or, if `complete`, not all of them."""
        if not isinstance(values, Mapping):
            raise ConfigError(f"{method} of {self._name} returns {_kind(values)}: return a dict of tensors by name")
        for name, value in values.items():
            if name not in like:
                raise ConfigError(f"{method} of {self._name} gives {name!r}, which its memories lack: declare it there")
            self._check(f"{name!r} from {method}", value, tuple(like[name].shape))
        if complete and (missing := [name for name in like if name not in values]):
            raise ConfigError(
                f"{method} of {self._name} gives no {missing[0]!r}: give every memory, an unchanged one as "
                f"self.memory[{missing[0]!r}]"
            )

    def _check_outcomes(self, outcomes: Any) -> None:
        if not isinstance(outcomes, Mapping):
            raise ConfigError(
                f"outcome_terms of {self._name} returns {_kind(outcomes)}: return a dict of tensors (W,) by name"
            )
        for name, value in outcomes.items():
            self._check(f"{name!r} in outcome_terms", value, (self._env.nworld,), "one number for each world")

    def _check(
        self,
        method: str,
        value: Any,
        shape: tuple[int, ...] | None,
        example: str = "one row for each world",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Raise ConfigError if a result is no tensor of this shape and type on the environment's device."""
        who, device = f"{method} of {self._name}", self._env.device
        if value is None:
            raise ConfigError(f"{who} returns nothing: end it with `return`, and {example}")
        if not isinstance(value, Tensor):
            raise ConfigError(
                f"{who} returns {_kind(value)}, not a tensor: compute it with torch, and return {example}"
            )
        if shape is not None and value.shape != shape:
            raise ConfigError(f"{who} has shape {tuple(value.shape)}, not {shape}: return {example}")
        if value.dtype != dtype:
            instead = example if dtype is torch.bool else "write .float(), and make constants with dtype=torch.float32"
            raise ConfigError(f"{who} returns {value.dtype}, not {dtype}: {instead}")
        if value.device != device:
            raise ConfigError(f"{who} is on {value.device}, not {device}: make constants with device=self.device")

    def _warn_of_cut_terms(self, terms: Tensor) -> None:
        env = self._env
        names = [env.reward_names[k] for k in terms_without_gradient(terms)]
        meant = {*env.without_gradient, *(term.name for term in env.terms if not term.gradient)}
        cut = [name for name in names if name not in meant]
        if not cut:
            return
        instead = "gradient=False in its Term" if env.terms else f"without_gradient = {tuple(cut)!r} in the class"
        which = "" if len(names) == len(env.reward_names) else f": {', '.join(cut)}"
        has = "have" if which and len(cut) > 1 else "has"
        warnings.warn(
            f"reward_terms of {self._name}{which} {has} no gradient to the state or the action: compute it with torch "
            "from state, frames, tendons and action, without comparisons, .detach(), .item() or numpy; if that is "
            f"meant, write {instead}",
            stacklevel=2,
        )

    def _described(self, error: Exception) -> str:
        """An exception in one line, with the place in the user's file, and what to write instead if that is known."""
        text = shortened(" ".join((str(error).splitlines() or [""])[0].split()), 200)
        frames = traceback.extract_tb(error.__traceback__)
        modules = [sys.modules.get(base.__module__) for base in type(self._env).__mro__]
        files = {getattr(module, "__file__", None) for module in modules}
        own = [frame for frame in frames if frame.filename in files and _PACKAGE not in Path(frame.filename).parents]
        place, hint = (own or frames)[-1], self._hint(error)
        at = f"{Path(place.filename).name}:{place.lineno}"
        return f"{type(error).__name__}: {text} ({at}){f'; {hint}' if hint else ''}"

    def _hint(self, error: Exception) -> str | None:
        env, text = self._env, str(error)
        if isinstance(error, AttributeError):
            settings = type(env.config)
            if type(env.config.reward) is Reward and text.startswith("'Reward' object"):
                return (
                    "write a class derived from Reward with every weight and its default, and a field "
                    "`reward: MyReward = MyReward()` in Settings"
                )
            if text.startswith((f"{settings.__name__!r} object", f"{type(env.config.reward).__name__!r} object")):
                return "declare the field with its default in that class"
            if error.obj is env:
                return f"set self.{error.name} in `prepare`"
        return next((hint for words, hint in _HINTS.items() if words in text), None)


def versions(*given: Given) -> list[int]:
    """How often each of some tensors has been changed in place."""
    return [tensor._version for _, tensor in _named(given)]


def _named(given: Sequence[Given]) -> list[tuple[str, Tensor]]:
    """The tensors among what methods are given, by the names that they have there."""
    names = iter(("action", "obs"))
    found: list[tuple[str, Tensor]] = []
    for value in given:
        if isinstance(value, StepState):
            found += [(f"state.{name}", part) for name, part in value._asdict().items()]
        elif isinstance(value, Mapping):
            found += [(f"self.memory[{name!r}]", part) for name, part in value.items()]
        else:
            found.append((next(names), value))
    return found


def _kind(value: Any) -> str:
    """What a value is, with an article."""
    name = type(value).__name__
    return "a numpy array" if name == "ndarray" else f"{'an' if name[0] in 'aeiou' else 'a'} {name}"
