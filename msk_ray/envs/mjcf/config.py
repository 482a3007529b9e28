"""The settings that environments made from an MJCF file share."""

from pydantic import PositiveFloat

from msk_ray.config.physics import SOLVING, STEPPING
from msk_ray.config.sections import Count, EnvSettings, NonNegative, Text


class MjcfSettings(EnvSettings):
    """A subclass adds a `reward` section and any other settings of its environment.

    Settings that the physics section leaves null keep the model's own values; so does the timestep, if neither
    `physics.substeps` nor `physics.timestep` is set.
    """

    reads_physics = STEPPING | SOLVING

    episode_length: Count = 500
    control_timestep: PositiveFloat = 0.02
    model: Text | None = None
    """Path of another MJCF file, relative to the folder of the environment's class; null: the class's own."""
    keyframe: Text | None = None
    """Keyframe that episodes start from; null: the model's first, or its reference configuration at rest."""
    reset_noise: NonNegative = 0.02
    """Spread of initial positions about the keyframe [m, rad], along every degree of freedom, within joint ranges."""
    reset_velocity_noise: NonNegative = 0.02
    """Spread of initial velocities [m/s, rad/s]."""

    def unread(self) -> dict[str, str]:
        if self.stochastic_reset:
            return {}
        return dict.fromkeys(("reset_noise", "reset_velocity_noise"), "env.stochastic_reset is false")
