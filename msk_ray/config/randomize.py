"""Model parameters to draw at random for each world and episode in training."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, model_validator

from msk_ray.config.sections import Section, Text


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
    only: Annotated[tuple[Text, ...], Field(max_length=1024)] | None = None
    """Names of the elements to change; null: all."""

    def __str__(self) -> str:
        times = "×" if self.mode == "scale" else ""
        same = self.low == self.high
        return f"{times}{self.low:g}" if same else f"{times}{self.low:g} to {times}{self.high:g}"


class Scaling(Draw):
    """Distribution of a factor on one model field."""

    mode: Literal["scale"] = "scale"


class RandomizeConfig(Section):
    """Distributions of model fields, named as in MuJoCo's MjModel; null: not randomized."""

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
    gravity: Scaling | None = None
    """Gravity."""

    @model_validator(mode="after")
    def _drawable(self) -> RandomizeConfig:
        if not self.drawn:
            raise ValueError(f"physics.randomize: write at least one of {', '.join(type(self).model_fields)}")
        for name, draw in self.drawn.items():
            if draw.low > draw.high:
                raise ValueError(
                    f"physics.randomize.{name}: low {draw.low:g} is above high {draw.high:g}; exchange them"
                )
        return self

    @property
    def drawn(self) -> dict[str, Draw]:
        """Distributions by field, without null ones."""
        return {name: draw for name in type(self).model_fields if (draw := getattr(self, name)) is not None}

    def __str__(self) -> str:
        return ", ".join(f"{name} {draw}" for name, draw in self.drawn.items())
