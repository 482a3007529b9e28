"""How a model is built, stepped and differentiated; and groups of these settings, for environments to declare."""

from typing import Literal

from pydantic import PositiveFloat, model_validator

from msk_ray.config.randomize import RandomizeConfig
from msk_ray.config.sections import Count, Section, Text

Vec2 = tuple[float, float]
Vec5 = tuple[float, float, float, float, float]

STEPPING = frozenset(
    (
        *("backward", "substep_grad_clip", "substeps", "timestep", "integrator"),
        *("fd.eps_ctrl", "fd.eps_qpos", "fd.eps_qvel"),
    )
)
"""Settings that every environment reads."""
GRADIENTS = frozenset(
    (
        *("backward", "substep_grad_clip"),
        *("fd.eps_ctrl", "fd.eps_qpos", "fd.eps_qvel", "fd.eps_act"),
    )
)
"""Settings of how steps are differentiated."""
SOLVING = frozenset((*("tolerance", "iterations", "ls_iterations", "cone"),))
"""Settings of the constraint solver, for models with contacts or limits."""
CONTACTS = frozenset(("solref", "solimp", "solreffriction"))
"""Settings of contacts, for models that declare their own."""
ACTIVATION = frozenset(("fd.eps_act",))
"""Settings for models with actuator activations."""


class FdConfig(Section):
    """Central differences of backward mode `fd_jacobian`."""

    eps_ctrl: PositiveFloat = 5e-3
    """Perturbation of ctrl [its own unit]."""
    eps_qpos: PositiveFloat = 5e-4
    """Perturbation of qpos along a tangent direction [m, rad]."""
    eps_qvel: PositiveFloat = 2e-3
    """Perturbation of qvel [m/s, rad/s]."""
    eps_act: PositiveFloat = 5e-4
    """Perturbation of act [its own unit]."""


class PhysicsConfig(Section):
    """How the model is built, stepped and differentiated. null keeps the variant's value."""

    variant: Text | None = None
    """Named physics of the environment: for hopper, cheetah and humanoid `published` or `matched`, for ant also
    `matched_hard_friction` and `matched_springs`."""
    backward: Literal["tape_per_substep", "tape_all", "fd_jacobian", "hybrid"] = "tape_per_substep"
    """Backward mode of the step. `tape_*` are exact; `fd_jacobian` differentiates any model by finite differences;
    `hybrid` takes the state's gradient from the tape and the control's from finite differences, for diagnosis."""
    substep_grad_clip: PositiveFloat | None = None
    """Bound on each world's state cotangent between substeps, in units of the loss; null: no bound. Tapes only."""
    fd: FdConfig = FdConfig()
    substeps: Count | None = None
    """Physics steps per env step. Set this or `timestep`; 4 if neither is set."""
    timestep: PositiveFloat | None = None
    """Duration of a physics step [s]; must divide the env's control_timestep."""
    tolerance: PositiveFloat | None = None
    """Constraint solver tolerance; mujoco_warp's default is 1e-6."""
    iterations: Count | None = None
    """Iteration limit of the constraint solver; null: the environment's. For a model file: its own, but at least
    100."""
    ls_iterations: Count | None = None
    """Iteration limit of the line search; null: likewise, but at least 50."""
    integrator: Literal["Euler", "implicitfast", "RK4"] | None = None
    cone: Literal["pyramidal", "elliptic"] | None = None
    """Friction cone. The pyramid's edges make contact gradients explode over long horizons; the ellipse has none."""
    solref: Vec2 | None = None
    """Contact time constant [s] and damping ratio."""
    solimp: Vec5 | None = None
    """Contact impedance d0, dwidth, width [m], midpoint, power."""
    solreffriction: Vec2 | None = None
    """Solver reference of the friction directions only [s, ratio], set on contact pairs; needs the elliptic cone.

    Friction acts like a damper with this time constant: (0.02, 1) sticks, (1, 1) is viscous. `(0, 0)` uses solref.
    """
    randomize: RandomizeConfig | None = None
    """Model parameters and disturbances to draw at random for each world and episode, in training only; null: none."""

    @model_validator(mode="after")
    def _friction_direction_needs_ellipse(self) -> "PhysicsConfig":
        if self.solreffriction is not None and self.cone == "pyramidal":
            raise ValueError("solreffriction only acts with the elliptic cone: write cone: elliptic")
        return self

    @model_validator(mode="after")
    def _substeps_of_one_step(self) -> "PhysicsConfig":
        late = self.randomize is not None and self.randomize.control_delay_substeps is not None
        if late and self.substep_grad_clip is not None:
            raise ValueError(
                "substep_grad_clip does not act with randomize.control_delay_substeps, whose substeps are steps of "
                "their own: leave one out"
            )
        return self

    @classmethod
    def names(cls) -> list[str]:
        """Every setting of the section that only some environments read, dotted."""
        return [
            *(name for name in cls.model_fields if name not in ("fd", "randomize")),
            *(f"fd.{name}" for name in FdConfig.model_fields),
        ]

    def in_substeps(self, count: int) -> "PhysicsConfig":
        """These settings with `count` physics steps per env step if they say neither that nor their duration."""
        given = self.substeps is not None or self.timestep is not None
        return self if given else self.model_copy(update={"substeps": count})

    def resolve_substeps(self, control_timestep: float) -> int:
        """Physics steps per env step of `control_timestep` [s].

        Raises:
            ValueError: `timestep` does not divide it, or `substeps` and `timestep` disagree.
        """
        if self.timestep is None:
            return self.substeps or 4
        ratio = control_timestep / self.timestep
        whole = round(ratio)
        if whole < 1 or abs(ratio - whole) > 1e-4 * whole:
            nearest = control_timestep / max(1, whole)
            raise ValueError(
                f"physics.timestep {self.timestep:g} s does not divide env.control_timestep {control_timestep:g} s: "
                f"write {nearest:.8g} ({max(1, whole)} substeps)"
            )
        if self.substeps is not None and self.substeps != whole:
            raise ValueError(
                f"physics.substeps {self.substeps} and physics.timestep {self.timestep:g} s disagree: "
                f"an env step of {control_timestep:g} s has {whole} such substeps; write one of the two"
            )
        return whole
