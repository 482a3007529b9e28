"""What is drawn at random in training: parameters of the model, and what disturbs a policy beside them."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, PositiveFloat, model_validator

from msk_ray.config.commands import Period, ascending
from msk_ray.config.sections import NonNegative, Section, Text, Whole

Names = Annotated[tuple[Text, ...], Field(max_length=1024)]
Steps = Annotated[tuple[Whole, Whole], AfterValidator(ascending)]


class Draw(Section):
    """Distribution of one model field."""

    low: PositiveFloat
    high: PositiveFloat
    distribution: Literal["uniform", "log_uniform"] = "uniform"
    """`log_uniform` draws factors of 1/2 and 2 equally often."""
    mode: Literal["scale", "value"] = "scale"
    """`scale` multiplies the model's value, `value` replaces it."""
    each: bool = False
    """Draw a number for each element, instead of one for all."""
    only: Names | None = None
    """Names of the elements to change; null: all."""

    def __str__(self) -> str:
        times = "×" if self.mode == "scale" else ""
        same = self.low == self.high
        return f"{times}{self.low:g}" if same else f"{times}{self.low:g} to {times}{self.high:g}"


class Scaling(Draw):
    """Distribution of a factor on one model field."""

    mode: Literal["scale"] = "scale"


class Payload(Section):
    """Distribution of what is added to one model field, uniform."""

    low: NonNegative
    high: PositiveFloat
    each: bool = False
    """Draw a number for each element, instead of one for all."""
    only: Names
    """Names of the elements to change."""

    def __str__(self) -> str:
        return f"+{self.low:g} to +{self.high:g}"


class Shift(Section):
    """Distribution of a vector that is added to one model field, uniform about 0."""

    size: tuple[NonNegative, NonNegative, NonNegative]
    """Largest size along x, y and z."""
    each: bool = False
    """Draw a vector for each element, instead of one for all."""
    only: Names | None = None
    """Names of the elements to change; null: all."""

    def __str__(self) -> str:
        return "±" + " ±".join(f"{size:g}" for size in self.size)


class Spread(Section):
    """Distribution about 0, in the unit of what is disturbed: one of both."""

    uniform: PositiveFloat | None = None
    """Largest size."""
    normal: PositiveFloat | None = None
    """Standard deviation."""

    @model_validator(mode="after")
    def _one_of_both(self) -> Spread:
        if (self.uniform is None) == (self.normal is None):
            raise ValueError("write one of uniform, normal")
        return self

    def __str__(self) -> str:
        return f"±{self.uniform:g}" if self.uniform is not None else f"σ {self.normal:g}"


Spreads = Annotated[dict[Text, Spread], Field(min_length=1, max_length=1024)]
"""Distributions by name, or by pattern such as `*_angle`."""


class Push(Section):
    """Kicks: sudden changes of velocity."""

    every: Period
    """Shortest and longest time from one to the next [s], uniform."""
    velocity: Annotated[dict[Text, Annotated[tuple[NonNegative, ...], Field(max_length=6)]], Field(min_length=1)]
    """Largest change of each velocity of a joint, by the joint's name [m/s, rad/s]: of a free joint x, y, z of the
    world, then about x, y, z of the body."""

    def __str__(self) -> str:
        return f"every {self.every[0]:g} to {self.every[1]:g} s"


class ModelRandomization(Section):
    """Distributions of factors on model fields, or of their values, named as in MuJoCo's MjModel; null: the model's."""

    geom_friction: Draw | None = None
    """Sliding friction of geoms."""
    pair_friction: Draw | None = None
    """Sliding friction of contact pairs, which ignore their geoms' friction."""
    body_mass: Scaling | None = None
    """Mass of bodies; scales their inertia by the same factor."""
    dof_damping: Draw | None = None
    """Damping of joints, by the joint's name [N s/m, N m s/rad]."""
    dof_armature: Draw | None = None
    """Rotor inertia of joints, by the joint's name [kg, kg m²]."""
    dof_frictionloss: Draw | None = None
    """Dry friction of joints, by the joint's name [N, N m]."""
    jnt_stiffness: Draw | None = None
    """Stiffness of joint springs [N/m, N m/rad]."""
    actuator_gear: Scaling | None = None
    """Gear of actuators, which scales forces and lengths."""
    actuator_gain: Scaling | None = None
    """Strength of actuators: scales gain and bias by the same factor, so that servos keep their targets."""
    actuator_kp: Scaling | None = None
    """Stiffness of position servos."""
    actuator_kd: Scaling | None = None
    """Damping of position servos."""
    gravity: Scaling | None = None
    """Gravity."""


class RandomizeConfig(ModelRandomization):
    """Model fields, what is added to some, and disturbances beside them; null: none."""

    payload: Payload | None = None
    """Mass added to bodies at their centres [kg]."""
    body_ipos: Shift | None = None
    """Centre of mass of bodies [m]."""
    gravity_shift: Shift | None = None
    """Gravity, by its direction too [m/s²]."""
    observation_noise: Spreads | None = None
    """Noise of entries of the observation by name, another one in every env step."""
    observation_bias: Spreads | None = None
    """Error of entries of the observation that stays the same for an episode."""
    encoder_bias: Spreads | None = None
    """Error of the encoders of joints, by their names, that stays the same for an episode [m, rad]: in entries of the
    observation called NAME_angle or NAME_position, and in what the joint's position servos do."""
    observation_delay: Steps | None = None
    """Fewest and most env steps by which observations are late, one number for an episode."""
    control_delay: Steps | None = None
    """Fewest and most env steps by which controls reach the actuators late, one number for an episode."""
    control_delay_substeps: Steps | None = None
    """Fewest and most substeps by which they are late besides, fewer than an env step has; one number for an
    episode."""
    push: Push | None = None
    """Kicks."""

    @model_validator(mode="after")
    def _drawable(self) -> RandomizeConfig:
        if not self._written:
            raise ValueError(f"physics.randomize: write at least one of {', '.join(type(self).model_fields)}")
        for name, draw in self.parameters.items():
            if not isinstance(draw, Shift) and draw.low > draw.high:
                raise ValueError(
                    f"physics.randomize.{name}: low {draw.low:g} is above high {draw.high:g}; exchange them"
                )
        return self

    @property
    def _written(self) -> dict[str, Any]:
        """Settings that are not null."""
        return {name: value for name in type(self).model_fields if (value := getattr(self, name)) is not None}

    @property
    def parameters(self) -> dict[str, Draw | Payload | Shift]:
        """Distributions of fields of the model, by field."""
        return {name: value for name, value in self._written.items() if isinstance(value, Draw | Payload | Shift)}

    def __str__(self) -> str:
        return ", ".join(f"{name} {_text(name, value)}" for name, value in self._written.items())


UNDISTURBED: Final = RandomizeConfig.model_construct()
"""No setting is written; a section of a file has at least one."""


def _text(name: str, value: Any) -> str:
    if isinstance(value, dict):
        return " and ".join(f"{entry} {spread}" for entry, spread in value.items())
    if isinstance(value, tuple):
        return f"{value[0]} to {value[1]} {'substeps' if name.endswith('substeps') else 'env steps'}"
    return str(value)
