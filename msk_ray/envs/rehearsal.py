"""Calls every method of an environment's class once when it is made, so that a mistake is said then."""

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from msk_ray.envs.contract import Contract, kind_of
from msk_ray.envs.cut_gradients import terms_without_gradient
from msk_ray.errors import ConfigError
from msk_ray.step import StepState

if TYPE_CHECKING:
    from msk_ray.envs.base import Env


def rehearse(env: "Env[Any]", contract: Contract) -> None:
    """Call every method in the environment's initial state; take `obs_size` from the observation where the class does
    not set it, and `critic_size`. Nothing that is drawn later changes.

    Raises:
        ConfigError: a method raises an exception, gives something of another kind, shape or type than it must, changes
            what it is given, or draws from a generator that does not repeat.
    """
    drawn, before = env.generator.get_state(), env.state
    _check_names(env)
    try:
        with torch.set_grad_enabled(env.sim.backward is not None):
            _observe(env, contract)
            action = _copy(env, torch.zeros_like(before.action))
            _begin_step(env, contract, action)
            _end_step(env, contract, StepState(*(_copy(env, part) for part in before.physics)), action)
    finally:
        env.generator.set_state(drawn)
        env.state, env.measurements.ignore_contact_forces = before, False
        env.release_graph()


def _copy(env: "Env[Any]", values: Tensor) -> Tensor:
    # No leaf, which torch would not let anything write to: that is for the contract to say.
    return values.detach().clone().requires_grad_(env.sim.backward is not None).clone()


def _observe(env: "Env[Any]", contract: Contract) -> None:
    given = env.state.physics, env.state.action
    obs = contract.call("observe", env.observation, *given)
    contract.check_observation("observe", obs)
    width = obs.shape[-1]
    declared = getattr(env, "obs_size", width)
    if declared != width:
        raise ConfigError(
            f"observe of {contract.name} has {width} entries, but its obs_size is {declared}: leave obs_size out"
        )
    env.obs_size = env.critic_size = width
    if env.asymmetric:
        seen = contract.call("observe_critic", lambda: env.observe_critic(*given), *given)
        contract.check_observation("observe_critic", seen)
        env.critic_size = seen.shape[-1]


def _begin_step(env: "Env[Any]", contract: Contract, action: Tensor) -> None:
    physics = env.state.physics
    disturbed = contract.call("disturbed", lambda: env.disturbed(physics), physics)
    contract.check_state("disturbed", disturbed, env.nworld)
    force = contract.call("applied_force", lambda: env.applied_force(physics), physics)
    if force is not None:
        contract.check("applied_force", force, (env.nworld, env.model.nv))
    controls = contract.call("control", lambda: env.control(action), physics, action)
    contract.check("control", controls, (env.nworld, env.model.nu), "one control for each actuator")


def _end_step(env: "Env[Any]", contract: Contract, after: StepState, action: Tensor) -> None:
    # No step has led to `after`, so that it has no contact forces.
    env.measurements.ignore_contact_forces = True
    memory = contract.call("remember", lambda: env.remembered(after, action), after, action, env.memory)
    contract.check_memory("remember", memory, env.memory)
    reached = env.reached(after, action)
    env.measurements.ignore_contact_forces = False
    obs = contract.call("observe", lambda: env.observation_of(reached), after, action)
    if env.asymmetric:
        contract.call("observe_critic", lambda: env.critic_observation_of(reached), after, action)
    env.measurements.ignore_contact_forces = True
    for term in env.active_terms:
        what, measure = f"term {term.name!r}", term.measure
        value = contract.call(what, lambda: measure(env, after, action, obs), after, action, obs)  # noqa: B023
        contract.check(what, value, (env.nworld,), "one number for each world")
    terms = contract.call("reward_terms", lambda: env.reward_terms(after, action, obs), after, action, obs)
    fell = contract.call("fell", lambda: env.fell(after), after, action)
    contract.check_results(obs, terms, fell)
    env.state = reached
    outcomes = contract.call("outcome_terms", lambda: env.outcome_terms(after), after, action)
    _check_outcomes(env, contract, outcomes)
    if env.sim.backward is not None:
        _warn_of_cut_terms(env, contract, terms)


def _check_names(env: "Env[Any]") -> None:
    name = type(env).__qualname__
    if not env.terms and not env.overrides("reward_terms"):
        raise ConfigError(
            f"{name} has no reward: write terms = (Term(name, weight, function), ...) in the class, or "
            "reward_names and the method reward_terms"
        )
    names = getattr(env, "reward_names", None)
    right = isinstance(names, tuple | list) and all(isinstance(name, str) for name in names)
    if not right or len(set(names or ())) != len(names or ()):
        given = "has no reward_names" if names is None else f"has reward_names {names!r}"
        raise ConfigError(
            f"{name} {given}: write a tuple of different names, one for each term, such as "
            "reward_names = ('forward', 'effort')"
        )


def _check_outcomes(env: "Env[Any]", contract: Contract, outcomes: Any) -> None:
    if not isinstance(outcomes, Mapping):
        raise ConfigError(
            f"outcome_terms of {contract.name} returns {kind_of(outcomes)}: return a dict of tensors (W,) by name"
        )
    for name, value in outcomes.items():
        contract.check(f"{name!r} in outcome_terms", value, (env.nworld,), "one number for each world")


def _warn_of_cut_terms(env: "Env[Any]", contract: Contract, terms: Tensor) -> None:
    """Warn of terms (W, T) that have no gradient and are not said to have none."""
    without = [env.reward_names[k] for k in terms_without_gradient(terms)]
    meant = {*env.without_gradient, *(term.name for term in env.terms if not term.gradient)}
    cut = [name for name in without if name not in meant]
    if not cut:
        return
    instead = "gradient=False in its Term" if env.terms else f"without_gradient = {tuple(cut)!r} in the class"
    which = "" if len(without) == len(env.reward_names) else f": {', '.join(cut)}"
    has = "have" if which and len(cut) > 1 else "has"
    warnings.warn(
        f"reward_terms of {contract.name}{which} {has} no gradient to the state or the action: compute it with torch "
        "from state, frames, tendons and action, without comparisons, .detach(), .item() or numpy; if that is "
        f"meant, write {instead}",
        stacklevel=2,
    )
