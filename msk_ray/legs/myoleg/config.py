"""The settings of installed legs."""

from typing import Literal

from pydantic import model_validator

from msk_ray.config.physics import ACTIVATION, SOLVING, STEPPING
from msk_ray.config.sections import NonNegative, Text
from msk_ray.legs.config import LegSettings


class MyoLegSettings(LegSettings):
    """Legs with 80 muscles, or those of a model file, walk at a target speed. The 80 are of an installed myosuite or
    myo_sim; contacts, limits and joints are the model's own."""

    reads_physics = STEPPING | SOLVING | ACTIVATION

    model: Text | None = None
    """Path of an MJCF file, or `myolegs` (80 muscles) or `myolegs26`; null: `myolegs`."""
    source: Literal["auto", "myosuite2", "myosuite3", "myo_sim"] = "auto"
    """Package of the model; `auto`: the first that is installed, in this order."""
    reset: Literal["stand", "cycle"] = "stand"
    """Initial states near the standing pose; `cycle`: near people's posture and speed at the clock's phase
    (`env.clock`), anywhere in the gait cycle."""
    reset_noise: NonNegative = 0.01
    """Spread of initial joint angles [rad]; coupled joints follow those they are coupled to."""

    @model_validator(mode="after")
    def _starts_with_the_clock(self) -> "MyoLegSettings":
        if self.reset == "cycle" and not self.clock:
            raise ValueError("env.reset: cycle starts at the clock's phase: write env.clock: true")
        return self

    def check_installed(self) -> None:
        from msk_ray.legs.myoleg.source import find_model  # loads MuJoCo

        find_model(self.model, self.source)

    def unread(self) -> dict[str, str]:
        unread = super().unread()
        if self.model not in (None, *PACKAGED_MODELS):
            unread["source"] = "env.model is the path of a file"
        return unread


PACKAGED_MODELS = ("myolegs", "myolegs26")
"""Models that installed packages have, the default first."""
