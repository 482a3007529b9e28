"""What all groups of settings are made of."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
NonNegative = Annotated[float, Field(ge=0.0)]


class Section(BaseModel):
    """A frozen group of settings that refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


class EnvSettings(Section):
    """What every environment has."""

    nworld: PositiveInt = 64
    """Worlds W simulated at once."""
    episode_length: PositiveInt
    """Env steps after which an episode is truncated."""
    control_timestep: PositiveFloat = 1.0 / 60.0
    """Duration of an env step [s]."""
    stochastic_reset: bool = True
    """Draw the initial state at random; False starts every episode in the same state."""
