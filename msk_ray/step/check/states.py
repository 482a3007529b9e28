"""States at which gradients are checked, one generator per kind, deterministic by seed.

C MuJoCo computes all of them in float64. They are then rounded to float32, so that Warp and the reference start from
the same numbers.
"""

from collections.abc import Callable

import mujoco
import numpy as np

from msk_ray.step.check.oracle import Array, Oracle, Point
from msk_ray.step.errors import ConfigError

_SETTLING_TIME = 0.5
"""How long a standing pose settles into its contacts [s]."""
_ROLLOUT_TIME = 2.0
"""Length of a contact or policy rollout [s]."""
_CONTROL_INTERVAL = 1.0 / 60.0
"""How long a rollout holds each control [s]; independent of the substeps under test, so that all have the same
states."""
_INSIDE = 0.9
"""Share of a control range to use, because the clamp has kinks at its bounds."""


def _span(model: mujoco.MjModel) -> tuple[Array, Array]:
    """Middle and half width of the usable control range of each actuator, each (nu,).

    Without a range: [0, 1] for a muscle, whose activation dynamics clamp to it, otherwise [-1, 1].
    """
    limited = model.actuator_ctrllimited.astype(bool)
    lowest = np.where(model.actuator_dyntype == mujoco.mjtDyn.mjDYN_MUSCLE, 0.0, -1.0)
    low = np.where(limited, model.actuator_ctrlrange[:, 0], lowest)
    high = np.where(limited, model.actuator_ctrlrange[:, 1], 1.0)
    return (low + high) / 2.0, _INSIDE * (high - low) / 2.0


def _random_ctrl(model: mujoco.MjModel, rng: np.random.Generator) -> Array:
    middle, half = _span(model)
    return middle + half * rng.uniform(-1.0, 1.0, model.nu)


def _gentle_ctrl(model: mujoco.MjModel, rng: np.random.Generator) -> Array:
    """Controls near zero, or near the nearest bound of a range without zero, but never on a bound."""
    middle, half = _span(model)
    rest = np.clip(0.0, middle - half, middle + half)
    nudge = 0.05 * half * rng.standard_normal(model.nu)
    # Move away from the bound, in case the rest value is on it.
    return rest + np.where(rest == 0.0, nudge, np.abs(nudge) * np.sign(middle - rest))


def _random_act(model: mujoco.MjModel, rng: np.random.Generator) -> Array:
    """Random activations inside their range, or in [0, 1] without one."""
    low, high = np.zeros(model.na), np.ones(model.na)
    for actuator in range(model.nu):
        if model.actuator_actlimited[actuator]:
            first, count = model.actuator_actadr[actuator], model.actuator_actnum[actuator]
            low[first : first + count], high[first : first + count] = model.actuator_actrange[actuator]
    return low + (high - low) * rng.uniform(0.05, 0.95, model.na)


def _displaced(model: mujoco.MjModel, qpos: Array, delta: Array) -> Array:
    moved = qpos.copy()
    mujoco.mj_integratePos(model, moved, delta, 1.0)
    return moved


def _start(model: mujoco.MjModel) -> Point:
    """Keyframe 0 if there is one, otherwise the reference configuration at rest under zero controls."""
    if model.nkey:
        return Point(*(key[0].copy() for key in (model.key_ctrl, model.key_qpos, model.key_qvel, model.key_act)))
    return Point(np.zeros(model.nu), model.qpos0.copy(), np.zeros(model.nv), np.zeros(model.na))


def _steps(oracle: Oracle, duration: float) -> int:
    """Env steps in `duration` [s], at least one."""
    return max(1, round(duration / (oracle.model.opt.timestep * oracle.substeps)))


def _settled(oracle: Oracle) -> Point:
    point = _start(oracle.model)
    for _ in range(_steps(oracle, _SETTLING_TIME)):
        point = oracle.step(point)
    return point


def standing(oracle: Oracle, worlds: int, rng: np.random.Generator) -> list[Point]:
    """The starting pose, settled into its contacts, then nudged differently in every world.

    The nudges (1 mm or mrad, 1 cm/s, controls of 5 %) make the worlds different and move them off kinks such as a
    muscle excitation of exactly zero.
    """
    model, rest = oracle.model, _settled(oracle)
    return [
        Point(
            _gentle_ctrl(model, rng),
            _displaced(model, rest.qpos, 1e-3 * rng.standard_normal(model.nv)),
            rest.qvel + 1e-2 * rng.standard_normal(model.nv),
            rest.act + 2e-2 * rng.uniform(0.5, 1.0, model.na) * np.where(rest.act > 0.5, -1.0, 1.0),
        )
        for _ in range(worlds)
    ]


def random(oracle: Oracle, worlds: int, rng: np.random.Generator) -> list[Point]:
    """The starting pose moved by 0.1 [m, rad] along random tangent directions, at random velocities of 0.5 [m/s]."""
    model, rest = oracle.model, _start(oracle.model)
    return [
        Point(
            _random_ctrl(model, rng),
            _displaced(model, rest.qpos, 0.1 * rng.standard_normal(model.nv)),
            0.5 * rng.standard_normal(model.nv),
            _random_act(model, rng),
        )
        for _ in range(worlds)
    ]


def contact(oracle: Oracle, worlds: int, rng: np.random.Generator) -> list[Point]:
    """One state in contact from each of `worlds` rollouts under random controls, which change every env step.

    If no rollout has any contact, draws from all states.
    """
    rollouts = []
    for _ in range(worlds):
        point, visited = _start(oracle.model), []
        for _ in range(_steps(oracle, _ROLLOUT_TIME)):
            point = Point(_random_ctrl(oracle.model, rng), point.qpos, point.qvel, point.act)
            visited.append((oracle.touching(point), point))
            point = oracle.step(point)
        rollouts.append(visited)
    any_touch = any(touching for visited in rollouts for touching, _ in visited)
    picked = []
    for visited in rollouts:
        choices = [point for touching, point in visited if touching or not any_touch]
        if choices:
            picked.append(choices[rng.integers(len(choices))])
    if len(picked) < worlds:
        # Replace rollouts without contact by further states of the others.
        pool = [point for visited in rollouts for touching, point in visited if touching]
        picked += [pool[rng.integers(len(pool))] for _ in range(worlds - len(picked))]
    return picked


def policy(oracle: Oracle, worlds: int, rng: np.random.Generator) -> list[Point]:
    """States evenly spread along one rollout under slow sinusoidal controls (0.5 to 2 Hz)."""
    model = oracle.model
    middle, half = _span(model)
    frequency, phase = rng.uniform(0.5, 2.0, model.nu), rng.uniform(0.0, 2.0 * np.pi, model.nu)
    count = max(_steps(oracle, _ROLLOUT_TIME), 2 * worlds)
    wanted = set(np.linspace(count // 10, count - 1, worlds).round().astype(int).tolist())
    point, picked = _start(model), []
    for k in range(count):
        time = k * model.opt.timestep * oracle.substeps
        ctrl = middle + 0.7 * half * np.sin(2.0 * np.pi * frequency * time + phase)
        point = Point(ctrl, point.qpos, point.qvel, point.act)
        if k in wanted:
            picked.append(point)
        point = oracle.step(point)
    return picked


STATE_KINDS: dict[str, Callable[[Oracle, int, np.random.Generator], list[Point]]] = {
    "standing": standing,
    "random": random,
    "contact": contact,
    "policy": policy,
}


def make_states(model: mujoco.MjModel, kind: str, worlds: int, seed: int) -> list[Point]:
    """`worlds` states of one kind, rounded to float32.

    Raises:
        ConfigError: unknown kind.
        SimulationError: the model diverges during a rollout.
    """
    generate = STATE_KINDS.get(kind)
    if generate is None:
        raise ConfigError(f"unknown kind of state {kind!r}: write one of {', '.join(STATE_KINDS)}")
    # One random stream per kind, so that leaving out a kind does not change the states of the others.
    rng = np.random.default_rng([seed, list(STATE_KINDS).index(kind)])
    oracle = Oracle(model, max(1, round(_CONTROL_INTERVAL / model.opt.timestep)))
    points = generate(oracle, worlds, rng)
    round32 = lambda value: value.astype(np.float32).astype(np.float64)  # noqa: E731
    return [Point(*(round32(v) for v in (p.ctrl, p.qpos, p.qvel, p.act))) for p in points]
