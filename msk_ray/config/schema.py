"""The settings of a trial. Every field has a unit or range; unknown keys are refused.

Sources of the defaults: SHAC (Xu et al. 2022, "Accelerated Policy Learning with Parallel Differentiable Simulation",
arXiv:2204.07137) and the hyperparameters published with it.
"""

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, PositiveFloat, Tag, model_validator

from msk_ray.config.legs import MyoLeg26EnvConfig, MyoLegEnvConfig
from msk_ray.config.sections import Count, EnvSettings, Fraction, NonNegative, Section, Text, Whole

Vec2 = tuple[float, float]
Vec5 = tuple[float, float, float, float, float]


VARIANTS: dict[str, tuple[str, ...]] = {
    "cartpole": (),
    "ant": ("matched", "matched_hard_friction", "published"),
    "myoleg26": (),
    "myoleg": (),
}
"""Named physics of each environment, the one that policies are scored under first."""

CONTACT_FIELDS = ("cone", "impratio", "solref", "solimp", "friction", "solreffriction", "solref_limit", "solimp_limit")
"""Fields of the physics section that mean something only in a model with contacts and joint limits."""


class CartPoleEnvConfig(EnvSettings):
    """Swing up a pole on a cart and keep it there. Angle 0 is upright."""

    name: Literal["cartpole"]
    episode_length: Count = 240
    pole_angle_penalty: NonNegative = 1.0
    """Weight of angle² [1/rad²], with the angle wrapped to ±π."""
    pole_velocity_penalty: NonNegative = 0.1
    """Weight of angular velocity² [s²/rad²]."""
    cart_position_penalty: NonNegative = 0.05
    """Weight of position² [1/m²]."""
    cart_velocity_penalty: NonNegative = 0.1
    """Weight of velocity² [s²/m²]."""
    cart_action_penalty: NonNegative = 0.0
    """Weight of action²."""


class AntEnvConfig(EnvSettings):
    """A four-legged walker whose reward asks for forward velocity."""

    name: Literal["ant"]
    episode_length: Count = 1000
    forward_vel: float = 1.0
    """Weight of the torso's velocity along +x [s/m]."""
    heading: float = 1.0
    """Weight of the cosine between the torso's forward axis and +x."""
    up: float = 0.1
    """Weight of the cosine between the torso's up axis and +z."""
    height: float = 1.0
    """Weight of the torso's height above `termination_height` [1/m]."""
    action_penalty: NonNegative = 0.0
    """Weight of the summed squared action."""
    termination_height: float = 0.27
    """Torso height below which an episode ends [m]."""
    early_termination: bool = True
    """End an episode on falling below `termination_height`."""


EnvConfig = Annotated[
    CartPoleEnvConfig | AntEnvConfig | MyoLeg26EnvConfig | MyoLegEnvConfig, Field(discriminator="name")
]


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
    max_worlds: Count = 131072
    """Perturbed copies run at once; more are done in chunks."""


class PhysicsConfig(Section):
    """How the model is built, stepped and differentiated. Fields left null keep the variant's value."""

    variant: Text | None = None
    """Named physics of the environment: for ant `published`, `matched` or `matched_hard_friction`."""
    backward: Literal["tape_per_substep", "tape_all", "fd_jacobian", "hybrid"] = "tape_per_substep"
    """Backward mode of the step. `tape_*` are exact; `fd_jacobian` differentiates any model by finite differences;
    `hybrid` takes the state's gradient from the tape and the control's from finite differences, for diagnosis."""
    substep_grad_clip: PositiveFloat | None = None
    """Bound on each world's state cotangent between substeps, in the loss's own units; null leaves it. Tapes only."""
    fd: FdConfig = FdConfig()
    substeps: Count | None = None
    """Physics steps an env step. Set this or `timestep`; 4 if neither is set."""
    timestep: PositiveFloat | None = None
    """Duration of a physics step [s]; must divide the env's control_timestep."""
    tolerance: PositiveFloat | None = None
    """Constraint solver tolerance; mujoco_warp's default is 1e-6."""
    iterations: Count | None = None
    """Constraint solver iteration limit."""
    ls_iterations: Count | None = None
    """Line search iteration limit."""
    integrator: Literal["Euler", "implicitfast", "RK4"] | None = None
    cone: Literal["pyramidal", "elliptic"] | None = None
    """Friction cone. The pyramid's edges make contact gradients explode over long horizons; the ellipse has none."""
    impratio: PositiveFloat | None = None
    """Ratio of frictional to normal constraint impedance."""
    solref: Vec2 | None = None
    """Contact time constant [s] and damping ratio."""
    solimp: Vec5 | None = None
    """Contact impedance d0, dwidth, width [m], midpoint, power."""
    friction: PositiveFloat | None = None
    """Sliding friction coefficient."""
    solreffriction: Vec2 | None = None
    """Solver reference of the friction directions alone [s, ratio], set on contact pairs; needs the elliptic cone.

    Friction acts like a damper with this time constant: (0.02, 1) sticks, (1, 1) is viscous. `(0, 0)` uses solref.
    """
    joint_damping: NonNegative | None = None
    """Damping of every actuated joint [N m s/rad]."""
    armature: NonNegative | None = None
    """Rotor inertia of every actuated joint [kg m²]."""
    solref_limit: Vec2 | None = None
    """Solver reference of joint limits; two negative values are -stiffness and -damping."""
    solimp_limit: Vec5 | None = None
    """Impedance of joint limits."""
    gear: PositiveFloat | None = None
    """Force or torque of a motor at full control [N, N m]."""
    nconmax: Count | None = None
    """Contacts a world; null takes a bound from the geometry."""
    njmax: Count | None = None
    """Constraint rows a world; null takes a bound from the geometry."""

    @model_validator(mode="after")
    def _friction_direction_needs_ellipse(self) -> "PhysicsConfig":
        if self.solreffriction is not None and self.cone == "pyramidal":
            raise ValueError("solreffriction acts with the elliptic cone only: write cone: elliptic")
        return self

    def resolve_substeps(self, control_timestep: float) -> int:
        """Physics steps an env step of `control_timestep` [s].

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


class HorizonSchedule(Section):
    """Rollout length by epoch: `start` at epoch 0, `end` from epoch `epochs` on, linear between."""

    start: Count
    end: Count
    epochs: Count

    def at(self, epoch: int) -> int:
        """Env steps at `epoch`, counted from 0."""
        progress = min(1.0, epoch / self.epochs)
        return round(self.start + (self.end - self.start) * progress)


class AdaptiveHorizon(Section):
    """Rollout length that follows the gradient: longer while cotangents stay small, shorter when they grow.

    After each epoch H ← H (target / p90)^rate within bounds, p90 being the 90th percentile of the state cotangents'
    norms in units of reward. Adaptive horizons are the idea of AHAC (Georgiev et al. 2024, arXiv:2405.17784), which
    follows a constraint on contact forces; this one follows the cotangents themselves.
    """

    start: Count
    shortest: Count = 4
    longest: Count = 64
    target: PositiveFloat
    """Wanted 90th percentile of the cotangent norms, before any bound [reward]."""
    rate: Annotated[float, Field(gt=0.0, le=1.0)] = 0.1

    @model_validator(mode="after")
    def _bounds(self) -> "AdaptiveHorizon":
        if not self.shortest <= self.start <= self.longest:
            raise ValueError(
                f"adaptive horizon: start {self.start} must lie between shortest {self.shortest} and longest "
                f"{self.longest}"
            )
        return self


def _kind_of_horizon(value: Any) -> str:
    if isinstance(value, dict):
        return "adaptive" if "target" in value else "schedule"
    if isinstance(value, AdaptiveHorizon):
        return "adaptive"
    return "schedule" if isinstance(value, HorizonSchedule) else "constant"


Horizon = Annotated[
    Annotated[Count, Tag("constant")]
    | Annotated[HorizonSchedule, Tag("schedule")]
    | Annotated[AdaptiveHorizon, Tag("adaptive")],
    Discriminator(_kind_of_horizon),
]


class EntropyConfig(Section):
    """Bonus α for the policy's entropy, as in SAPO (Xing et al. 2024, arXiv:2412.12089); values become soft values."""

    coefficient: PositiveFloat = 0.01
    """α [reward per nat], or where it starts if there is a target."""
    target: float | None = None
    """Entropy per action dimension [nat] that α is adapted to hold; null keeps α. Uniform actions have ln 2 = 0.69."""
    rate: PositiveFloat = 5e-3
    """Change of log α per epoch and nat of missing entropy."""


class ContactStart(Section):
    """Contact physics at the start of a curriculum; fields left null stay as the trial's physics has them."""

    solref: tuple[PositiveFloat, PositiveFloat] | None = None
    """Contact time constant [s] and damping ratio."""
    solimp: Vec5 | None = None
    solreffriction: tuple[PositiveFloat, PositiveFloat] | None = None
    """Time constant [s] and damping ratio of the friction directions; (1, 1) is viscous."""
    friction: PositiveFloat | None = None
    """Sliding friction coefficient."""

    @model_validator(mode="after")
    def _something(self) -> "ContactStart":
        if not self.model_dump(exclude_none=True):
            raise ValueError("write at least one of solref, solimp, solreffriction, friction")
        return self


class ContactCurriculum(Section):
    """Train first in softer contacts, and go over to those of `physics` step by step."""

    start: ContactStart
    epochs: Count
    """Steps from `start` to the trial's physics, one an epoch."""
    reward: float | None = None
    """Mean reward per env step an epoch must reach for a step to be taken; null takes one every epoch."""


class NetworkConfig(Section):
    """A multilayer perceptron."""

    hidden: Annotated[tuple[Annotated[int, Field(gt=0, le=65536)], ...], Field(max_length=64)] = (64, 64)
    activation: Literal["elu", "silu", "relu", "tanh"] = "elu"
    layer_norm: bool = True
    """Normalise each hidden layer."""


class ActorConfig(NetworkConfig):
    """Policy network. Its output is squashed by tanh."""

    stochastic: bool = True
    """Gaussian with state-independent standard deviation; False is deterministic."""
    log_std: float = -1.0
    """Initial log standard deviation, before tanh."""
    output_gain: PositiveFloat = 1.0
    """Gain of the last layer's initial weights; a small one starts from action 0, whatever is observed."""


class CriticConfig(NetworkConfig):
    """Value network(s)."""

    count: Annotated[int, Field(ge=1, le=2)] = 1
    """Critics trained; with two, the smaller value is used."""


class ShacConfig(Section):
    """Short-Horizon Actor-Critic."""

    horizon: Horizon = 32
    """Env steps H of a rollout the gradient flows through: constant, {start, end, epochs}, or by the gradient as
    {start, target}."""
    gamma: Fraction = 0.99
    """Discount."""
    lam: Fraction = 0.95
    """λ of the TD(λ) targets."""
    critic_method: Literal["td-lambda", "one-step"] = "td-lambda"
    """Targets of the critic."""
    critic_iterations: Count = 16
    """Passes over the rollout an epoch."""
    critic_batches: Count = 4
    """Minibatches a pass."""
    target_critic_alpha: Fraction = 0.2
    """target ← α·target + (1 − α)·critic after each epoch."""
    actor_lr: PositiveFloat = 2e-3
    critic_lr: PositiveFloat = 2e-3
    lr_schedule: Literal["linear", "constant"] = "linear"
    """`linear` goes from the given rate to `final_lr` at the last epoch."""
    final_lr: PositiveFloat = 1e-5
    betas: tuple[Fraction, Fraction] = (0.7, 0.95)
    """Adam's moment decays."""
    actor_grad_norm: PositiveFloat | None = 1.0
    """Norm the actor's gradient is clipped to; null leaves it."""
    critic_grad_norm: PositiveFloat | None = 1.0
    """Norm each critic's gradient is clipped to; null leaves it."""
    state_bptt: bool = True
    """Let gradients flow through the state from one env step to the next; False cuts them after each step."""
    state_grad_clip: PositiveFloat | None = None
    """Bound on each world's state cotangent between env steps, in units of reward; null leaves it.

    The loss is a mean over H·W, so a world's cotangent of norm c/(H·W) is what one reward of c would give.
    """
    entropy: EntropyConfig | None = None
    """Bonus for the policy's entropy; null gives none."""
    normalize_obs: bool = True
    """Normalise observations by their running mean and variance."""
    normalize_return: bool = False
    """Divide rewards by the running standard deviation of the return."""
    reward_scale: PositiveFloat = 1.0
    max_nonfinite_share: Fraction = 0.05
    """Share of worlds whose gradient may be non-finite in an epoch before the trial stops with an error."""


class EvaluationConfig(Section):
    """Deterministic evaluation on fixed seeds: the only thing policies are ranked by."""

    interval: Count = 10
    """Epochs between evaluations."""
    nworld: Count = 64
    steps: Count | None = None
    """Env steps; null takes the env's episode length."""
    seed: Whole = 1234
    variant: Text | None = None
    """Physics the score is taken under; null takes the env's reference physics."""


class TrialConfig(Section):
    """How long, from which seed, and how often to save."""

    epochs: Count = 500
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    start_from: Text | None = None
    """Checkpoint of another trial whose networks and observation statistics this one starts from, such as a best.pt;
    null starts from random ones. Optimisers and worlds are new either way."""
    checkpoint_interval: Count = 10
    """Epochs between checkpoints."""
    keep_checkpoints: Annotated[int, Field(ge=2)] = 2
    """Newest checkpoints kept, beside the best."""


class Config(Section):
    """One trial."""

    env: EnvConfig
    physics: PhysicsConfig = PhysicsConfig()
    curriculum: ContactCurriculum | None = None
    """Softer contacts to begin with; null trains in `physics` from the start."""
    shac: ShacConfig = ShacConfig()
    actor: ActorConfig = ActorConfig()
    critic: CriticConfig = CriticConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    trial: TrialConfig = TrialConfig()

    @model_validator(mode="after")
    def _physics_fits_env(self) -> "Config":
        variants = VARIANTS[self.env.name]
        for field, name in (("physics.variant", self.physics.variant), ("evaluation.variant", self.evaluation.variant)):
            if name is not None and name not in variants:
                known = f"write one of {', '.join(variants)}" if variants else "leave it out"
                raise ValueError(f"{field}: env {self.env.name} has no physics named {name!r}; {known}")
        if self.env.name == "cartpole":
            set_ = [name for name in CONTACT_FIELDS if getattr(self.physics, name) is not None]
            if set_:
                raise ValueError(f"physics.{set_[0]}: cartpole has no contacts or joint limits; leave it out")
        return self

    @model_validator(mode="after")
    def _consistent(self) -> "Config":
        self.physics.resolve_substeps(self.env.control_timestep)
        horizon = self.shac.horizon
        if isinstance(horizon, HorizonSchedule):
            shortest = min(horizon.start, horizon.end)
        else:
            shortest = horizon if isinstance(horizon, int) else horizon.shortest
        if (shortest * self.env.nworld) % self.shac.critic_batches:
            raise ValueError(
                f"shac.critic_batches {self.shac.critic_batches} must divide shac.horizon × env.nworld "
                f"({shortest} × {self.env.nworld})"
            )
        if self.shac.entropy is not None and not self.actor.stochastic:
            raise ValueError("shac.entropy needs a stochastic policy: write actor.stochastic: true")
        if self.curriculum is not None:
            self._check_curriculum()
        return self

    def _check_curriculum(self) -> None:
        if self.env.name == "cartpole":
            raise ValueError("curriculum: cartpole has no contacts; leave it out")
        if self.physics.backward not in ("tape_per_substep", "tape_all"):
            raise ValueError("curriculum needs physics.backward: tape_per_substep or tape_all")

    def as_dict(self) -> dict[str, Any]:
        """Plain data that `parse_config` reads back."""
        return self.model_dump(mode="json")
