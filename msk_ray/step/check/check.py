"""Gradients of a Simulation compared with the float64 reference, state by state.

Axes: W worlds of one kind of state, R = 2 nv + na rows, the tangent of (qpos', qvel', act').
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from msk_ray.step.autograd import Simulation
from msk_ray.step.autograd.tape import UNCONVERGED_BOUND
from msk_ray.step.check.nonfinite import NonFinite, find_nonfinite
from msk_ray.step.check.oracle import Array, Linearization, Oracle, Point
from msk_ray.step.check.pullback import simulated_gradients
from msk_ray.step.check.states import STATE_KINDS, make_states
from msk_ray.step.errors import ConfigError
from msk_ray.step.forward.parameters import check_names
from msk_ray.step.forward.solver_limits import ENOUGH, SolverLimits

_VANISHING = 1e-9
"""A reference gradient below this share of its cotangent counts as zero: it is rounding of the differences."""
_STANDARD_GRAVITY = 9.81


@dataclass(frozen=True)
class Limits:
    """Limits above which a state is left out of the comparison."""

    step_disagreement: float = 1e-3
    """Kink: derivatives with the reference's two step sizes differ by more than this, relative. The reference itself
    may then be wrong by 1 % of that."""
    side_disagreement: float = 1e-2
    """Kink: the reference's one-sided differences differ by more than this, relative. In smooth, stiff contact they
    differ by 3e-3."""
    forward_mismatch: float = 3e-5
    """Forward mismatch: Warp's results differ from C MuJoCo's by more than this, relative to the motion of the step.

    Float32 rounding gives up to 2e-5 on an ant in contact over 16 substeps; a different contact frame 4e-5 to 1e-1.
    """


@dataclass(frozen=True)
class Comparison:
    """One input's gradient at one state."""

    state: str
    """Kind of state."""
    world: int
    """Index among the states of that kind."""
    input: str
    """ctrl, qpos, qvel, act, or a parameter's name."""
    rel_error: float
    """‖g − g_ref‖ / ‖g_ref‖; where the reference vanishes, ‖g‖ / ‖cotangent‖. Infinite where g is not finite."""
    cosine: float | None
    """Cosine between g and g_ref; None where either vanishes or is not finite."""
    norm_ratio: float | None
    """‖g‖ / ‖g_ref‖; None where the reference vanishes or g is not finite."""


@dataclass
class GradientCheck:
    """The result of a check."""

    mode: str
    substeps: int
    worlds: int
    """States of each kind."""
    limits: SolverLimits = ENOUGH
    """Iteration limits of the solver and of each line search."""
    results: list[Comparison] = field(default_factory=list)
    kinks: int = 0
    """States left out because the step is not differentiable there."""
    forward_mismatches: int = 0
    """States left out because Warp's forward pass differs from C MuJoCo's."""
    checked: int = 0
    """States compared."""
    parameter_kinks: int = 0
    """Elements of parameters left out because the step is not differentiable by them."""
    diagnostics: dict[str, float] = field(default_factory=dict)
    """Diagnostics of the simulation and its backward mode, the largest over the kinds of state."""
    nonfinite: list[NonFinite] = field(default_factory=list)
    """States, compared or left out, at which the step or its gradient is not finite."""

    @property
    def excluded(self) -> int:
        """States left out."""
        return self.kinks + self.forward_mismatches

    @property
    def unconverged(self) -> bool:
        """Whether the solver had not converged in too many substeps."""
        return self.diagnostics.get("solver_unconverged_substeps", 0.0) > UNCONVERGED_BOUND

    @property
    def max_rel_error(self) -> float:
        """The largest relative error; infinite, which means failure, if anything is not finite or nothing was
        compared."""
        if self.nonfinite:
            return math.inf
        return max((r.rel_error for r in self.results), default=math.inf)

    def of(self, name: str, state: str | None = None) -> list[Comparison]:
        """Comparisons of one input, for one kind of state or all."""
        return [r for r in self.results if r.input == name and state in (None, r.state)]


def compare(gradient: Array, reference: Array, cotangent_norm: float) -> tuple[float, float | None, float | None]:
    """(relative error, cosine, norm ratio) of a gradient."""
    if not np.all(np.isfinite(gradient)):
        return math.inf, None, None
    norm, expected = float(np.linalg.norm(gradient)), float(np.linalg.norm(reference))
    if expected <= _VANISHING * cotangent_norm:
        return norm / cotangent_norm, None, None
    error = float(np.linalg.norm(gradient - reference)) / expected
    cosine = float(gradient @ reference) / (norm * expected) if norm > 0.0 else None
    return error, cosine, norm / expected


def forward_mismatch(oracle: Oracle, start: Point, expected: Point, actual: Point) -> float:
    """Difference between a float32 step and the float64 one, relative to the step's motion; infinite if not finite.

    Differences of positions are relative to their change, of velocities to the speeds before and after, both at least
    one env step of free fall; of activations absolute, because these are of order one. Unavoidable rounding of the
    state itself is subtracted from the difference of positions.
    """
    if not all(np.all(np.isfinite(v)) for v in (actual.qpos, actual.qvel, actual.act)):
        return math.inf
    nv = oracle.model.nv
    error, motion = oracle.difference(expected, actual), oracle.difference(start, expected)
    duration = oracle.model.opt.timestep * oracle.substeps
    speed = float(np.linalg.norm(start.qvel) + np.linalg.norm(expected.qvel)) + duration * _STANDARD_GRAVITY
    rounding = 8.0 * float(np.finfo(np.float32).eps) * float(np.linalg.norm(expected.qpos))
    position = max(0.0, float(np.linalg.norm(error[:nv])) - rounding)
    return max(
        position / (float(np.linalg.norm(motion[:nv])) + duration * speed),
        float(np.linalg.norm(error[nv : 2 * nv])) / speed,
        float(np.max(np.abs(error[2 * nv :]), initial=0.0)),
    )


def check_request(model: mujoco.MjModel, states: Sequence[str]) -> None:
    """Raise ConfigError for an unknown kind of state, or a model without degrees of freedom."""
    unknown = [kind for kind in states if kind not in STATE_KINDS]
    if unknown or not states:
        raise ConfigError(f"unknown kinds of state {unknown}: choose from {', '.join(STATE_KINDS)}")
    if model.nv == 0:
        raise ConfigError("the model has no degrees of freedom, so there is no gradient to check")


def check_gradients(
    sim: Simulation,
    *,
    states: Sequence[str] = ("standing", "random"),
    seed: int = 0,
    limits: Limits | None = None,
    parameters: Sequence[str] = (),
    pace: Callable[[int], None] | None = None,
) -> GradientCheck:
    """Compare gradients of one env step of `sim` with float64 central differences of C MuJoCo.

    Every state gets its own random normal cotangent on all of (qpos', qvel', act').

    Args:
        sim: the simulation, with a backward mode; its number of worlds W is the number of states of each kind.
        states: kinds of state, from `STATE_KINDS`.
        seed: seed of the states and cotangents.
        limits: limits for kinks and forward mismatches.
        parameters: model fields whose gradients are compared too, at the model's own values.
        pace: called after each state with the number of states done.

    Returns:
        The comparisons; if every state was excluded there are none, and `max_rel_error` is infinite.

    Raises:
        ConfigError: unknown kind of state or parameter, a model without degrees of freedom, or a simulation that is
            forward only.
        UnsupportedModelError: the mode has no gradients of parameters, or the model cannot vary one of them.
        SimulationError: the model diverges in C MuJoCo, or Warp's buffers were too small for its contacts.
    """
    model, worlds, substeps = sim.model, sim.nworld, sim.substeps
    check_request(model, states)
    if sim.backward is None:
        raise ConfigError("this Simulation has no gradient to check: make it with a backward mode")
    check_names(model, parameters)
    oracle, limits = Oracle(model, substeps, parameters), limits or Limits()
    result = GradientCheck(sim.backward.name, substeps, worlds, sim.batch.limits)
    done = 0
    for kind in dict.fromkeys(states):
        points = make_states(model, kind, worlds, seed)
        rng = np.random.default_rng([seed, list(STATE_KINDS).index(kind), 1])
        # Rounded to float32, so that both sides use the same cotangents.
        cotangents = rng.standard_normal((worlds, 2 * model.nv + model.na)).astype(np.float32).astype(np.float64)
        ends, gradients = simulated_gradients(sim, points, cotangents, parameters)
        for name, figure in sim.diagnostics().items():
            result.diagnostics[name] = max(result.diagnostics.get(name, -math.inf), figure)
        for world, (point, end) in enumerate(zip(points, ends, strict=True)):
            own = {name: gradient[world] for name, gradient in gradients.items()}
            lost = find_nonfinite(sim, kind, world, point, end, own)
            if lost is not None:
                result.nonfinite.append(lost)
            reference = oracle.linearize(point)
            if forward_mismatch(oracle, point, reference.end, end) > limits.forward_mismatch:
                result.forward_mismatches += 1
            elif reference.at_kink(limits.step_disagreement, limits.side_disagreement):
                result.kinks += 1
            else:
                result.checked += 1
                result.parameter_kinks += int(sum(bent.sum() for bent in reference.bent.values()))
                result.results += _comparisons(kind, world, reference, cotangents[world], own)
            done += 1
            if pace is not None:
                pace(done)
    return result


def _comparisons(
    kind: str, world: int, reference: Linearization, cotangent: Array, gradients: dict[str, Array]
) -> list[Comparison]:
    norm = float(np.linalg.norm(cotangent))
    out = []
    for name, expected in reference.pull_back(cotangent).items():
        smooth = ~reference.bent.get(name, np.zeros(len(expected), bool))
        if np.any(smooth):
            out.append(Comparison(kind, world, name, *compare(gradients[name][smooth], expected[smooth], norm)))
    return out
