"""Iteration limits of the constraint solver, by default high enough for it to converge."""

import warnings
from typing import Final, NamedTuple

import mujoco

from msk_ray.step.errors import ConfigError


class SolverLimits(NamedTuple):
    """Iteration limits of the constraint solver and of each line search."""

    iterations: int
    ls_iterations: int


ENOUGH: Final = SolverLimits(100, 50)
"""MuJoCo's defaults. Worlds stop when they have converged, so a high limit only costs time for those that need it."""


def own_limits(model: mujoco.MjModel) -> SolverLimits:
    """The model's limits."""
    return SolverLimits(int(model.opt.iterations), int(model.opt.ls_iterations))


def choose_limits(model: mujoco.MjModel, iterations: int | None, ls_iterations: int | None) -> SolverLimits:
    """The given limits; for None, the model's, but at least `ENOUGH`.

    Raises:
        ConfigError: a given limit is below 1.
    """
    chosen = []
    for name, given, own, enough in zip(
        ENOUGH._fields, (iterations, ls_iterations), own_limits(model), ENOUGH, strict=True
    ):
        if given is not None and given < 1:
            raise ConfigError(f"{name} must be at least 1, not {given}")
        chosen.append(max(own, enough) if given is None else given)
    return SolverLimits(*chosen)


def warn_raised_limits(model: mujoco.MjModel, iterations: int | None, ls_iterations: int | None) -> None:
    """Warn if `choose_limits` with these arguments allows more iterations than the model itself."""
    own, chosen = own_limits(model), choose_limits(model, iterations, ls_iterations)
    given = {"iterations": iterations, "ls_iterations": ls_iterations}
    raised = [name for name in own._fields if given[name] is None and getattr(chosen, name) > getattr(own, name)]
    if not raised:
        return
    allowed = " and ".join(f"{name} {getattr(chosen, name)} instead of {getattr(own, name)}" for name in raised)
    settings = " and ".join(f"physics.{name}: {getattr(own, name)}" for name in raised)
    arguments = ", ".join(f"{name}={getattr(own, name)}" for name in raised)
    options = " ".join(f"--{name.replace('_', '-')} {getattr(own, name)}" for name in raised)
    warnings.warn(
        "the model may stop the constraint solver before it has converged, where gradients are wrong: it runs with "
        f"{allowed}; to keep the model's own, write {settings} in a config, "
        f"kernels=Kernels({arguments}) in Python, {options} in gradcheck",
        stacklevel=1,
    )
