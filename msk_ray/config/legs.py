"""The settings of the muscle-driven legs."""

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from msk_ray.config.physics import ACTIVATION, CONTACTS, JOINTS, LIMITS, SOLVING, STEPPING
from msk_ray.config.sections import Count, EnvSettings, Fraction, NonNegative, Reward, Section, Text, Whole


class TerrainConfig(Section):
    """Ground of a leg model, made of primitives along +x."""

    kind: Literal["flat", "slope", "steps", "rough", "height_field"] = "flat"
    """`height_field` has no exact gradient: it needs physics.backward=fd_jacobian."""
    slope: float = 0.1
    """Rise over run of `slope`; negative goes down."""
    step_height: NonNegative = 0.05
    """Rise of each of the `steps` [m]."""
    step_depth: PositiveFloat = 0.6
    """Length along x of each step or rough strip [m]."""
    roughness: NonNegative = 0.03
    """Largest height of `rough` strips and `height_field` [m]."""
    start: NonNegative = 0.8
    """Where the ground stops being flat [m]; a slope starts at the origin."""
    seed: Whole = 0
    """Of the heights of `rough` and `height_field`."""


_TERRAIN_READS: dict[str, tuple[str, ...]] = {
    "flat": (),
    "slope": ("slope",),
    "steps": ("step_height", "step_depth", "start"),
    "rough": ("step_depth", "roughness", "start", "seed"),
    "height_field": ("roughness", "start", "seed"),
}
"""What each kind of ground is made by."""


class AssistConfig(Section):
    """Springs and dampers that hold the pelvis up during training, annealed linearly to nothing.

    Evaluation never has them.
    """

    epochs: Whole = 0
    """Epochs until they are gone; 0 has none at all."""
    share: Fraction = 1.0
    """Of the stiffness below, at epoch 0."""
    balance: NonNegative = 800.0
    """Righting torque of tilt and list [N m/rad]; of the turn as much less as its inertia is. Critically damped."""
    lateral: NonNegative = 800.0
    """Force towards the line walked on [N/m]. Critically damped."""
    support: Fraction = 0.0
    """Share of the body's weight that is carried."""


class LegReward(Reward):
    """Weights per control step."""

    forward_vel: float = 1.0
    """Weight of exp(-((v - env.target_speed) / speed_scale)²)."""
    speed_scale: PositiveFloat = 0.6
    """Speed error at which the term above has fallen to 1/e [m/s]."""
    progress: float = 0.0
    """Weight of the forward speed, up to env.target_speed [s/m]: a slope where the term above is flat."""
    upright: float = 2.0
    """Weight of the cosine between the trunk's up axis and +z."""
    heading: float = 0.2
    """Weight of the cosine between the pelvis's forward axis and +x."""
    height: NonNegative = 5.0
    """Weight of (drop below the standing height)² [1/m²]."""
    alive: float = 0.5
    """Reward for every step without a fall."""
    effort: NonNegative = 0.2
    """Weight of the mean squared activation: nothing at rest."""
    joint_limit: NonNegative = 0.1
    """Weight of the summed squared overshoot past joint limits less a margin of 0.05 rad, in units of 0.1 rad."""
    smoothness: NonNegative = 0.02
    """Weight of the mean squared change of the action."""
    capture: NonNegative = 0.3
    """Weight of √(1 + (d / capture_scale)²) - 1, d being the distance of the capture point from the line walked on, or
    from the start if asked to stand. That point is where the body would come to rest as a pendulum,
    x + v / √(g / height), with x and v of its centre of mass taken from pelvis and lean of the trunk."""
    capture_scale: PositiveFloat = 0.1
    """Distance from which the term above grows in proportion [m]: a fall must not cost without bound."""
    sway: NonNegative = 0.02
    """Weight of the squared angular velocity of the pelvis [s²/rad²]."""
    symmetry: NonNegative = 0.0
    """Weight of the squared sum of both hips' flexion rates [s²/rad²]: legs in antiphase, without a reference gait."""
    stride: NonNegative = 0.0
    """Weight of (r - 1)² with r² = (d / stride_angle)² + (d' / (stride_angle ω))², d being the angle between both hips'
    flexions, d' its rate, ω = 2π cadence / 120 s. Nothing is paid where the legs swing against each other as a pendulum
    of that angle and cadence, in whatever phase; quick small steps pay at each of their turning points."""
    stride_angle: PositiveFloat = 0.75
    """Largest angle between the hips' flexions [rad]: 2 asin(step length / (2 leg length)) for 0.67 m and 0.9 m."""
    cadence: PositiveFloat = 112.0
    """Steps a minute; at 1.25 m/s people take about as many [1/min]."""


class LegEnvSettings(EnvSettings):
    """What the muscle-driven legs share."""

    episode_length: Count = 500
    control_timestep: PositiveFloat = 0.02
    target_speed: NonNegative = 1.25
    """Forward speed asked for [m/s]; 0 asks to stand."""
    min_height: float = 0.65
    """Pelvis height above the ground, as a share of standing, below which an episode ends."""
    min_upright: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.5
    """Cosine between the trunk's up axis and +z below which an episode ends."""
    early_termination: bool = True
    """End an episode on a fall."""
    rest_excitation: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.02
    """Least excitation of a muscle at action 0, where standing keyframes do not ask for more."""
    success_speed: NonNegative = 0.8
    """Mean speed over the episode from which walking counts as a success [m/s]."""
    reward: LegReward = LegReward()

    def unread(self) -> dict[str, str]:
        unread = {}
        if not self.early_termination:
            unread["min_height"] = "env.early_termination is false"
        if self.target_speed == 0.0:
            unread["success_speed"] = "env.target_speed 0 asks to stand"
        return unread


class MyoLeg26EnvConfig(LegEnvSettings):
    """Two legs under one trunk, 13 Hill-type muscles each."""

    reads_physics = STEPPING | SOLVING | CONTACTS | LIMITS | JOINTS | ACTIVATION

    name: Literal["myoleg26"]
    terrain: TerrainConfig = TerrainConfig()
    assist: AssistConfig = AssistConfig()
    reset: Literal["stand", "walk", "mixed"] = "stand"
    """Initial states about the standing keyframe, the two walking ones, or all three alike."""
    reset_noise: NonNegative = 0.02
    """Spread of initial joint angles [rad]; velocities, the pelvis's among them, spread five times that a second, which
    moves the capture point by 3 cm: feet on the spot can still catch it."""

    def unread(self) -> dict[str, str]:
        unread = super().unread()
        reads = _TERRAIN_READS[self.terrain.kind]
        for name in TerrainConfig.model_fields:
            if name != "kind" and name not in reads:
                unread[f"terrain.{name}"] = f"env.terrain.kind is {self.terrain.kind}"
        if not self.assist.epochs:
            for name in ("share", "balance", "lateral", "support"):
                unread[f"assist.{name}"] = "env.assist.epochs is 0"
        return unread


class MyoLegEnvConfig(LegEnvSettings):
    """Legs of an installed myosuite or myo_sim, or of a model file: its contacts, limits and joints are its own."""

    reads_physics = STEPPING | SOLVING | ACTIVATION

    name: Literal["myoleg"]
    model: Text | None = None
    """Path of an MJCF file, or `myolegs` (80 muscles) or `myolegs26`; null takes `myolegs`."""
    source: Literal["auto", "myosuite2", "myosuite3", "myo_sim"] = "auto"
    """Package to take it from; `auto` takes the first that is installed, in this order."""
    reset_noise: NonNegative = 0.01
    """Spread of initial joint angles [rad]; coupled joints follow those they are coupled to."""

    def unread(self) -> dict[str, str]:
        unread = super().unread()
        if self.model not in (None, *PACKAGED_MODELS):
            unread["source"] = "env.model is the path of a file"
        return unread


PACKAGED_MODELS = ("myolegs", "myolegs26")
"""Models that installed packages have, the default first."""
