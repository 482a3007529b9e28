"""The settings and terms that bodies with motors share."""

from msk_ray.config.schedules import ramp
from msk_ray.config.sections import EnvSettings, Whole
from msk_ray.config.terms import Cost


class LimitedSettings(EnvSettings):
    """The settings of a body that training can charge for joints past their ranges."""

    joint_limit_epochs: Whole = 0
    """Epochs over which the weight `reward.joint_limit` falls linearly to 0; 0: it stays."""

    def joint_limit_share(self, epoch: int) -> float:
        """What is left of the weight at `epoch`, counted from 0."""
        return ramp(1.0, 0.0, epoch, self.joint_limit_epochs) if self.joint_limit_epochs else 1.0


class FallingSettings(LimitedSettings):
    """The settings of a body that can fall."""

    termination_height: float
    """Height of the torso below which an episode ends [m]."""
    early_termination: bool = True
    """End an episode on falling below `termination_height`."""

    def unread(self) -> dict[str, str]:
        return {} if self.early_termination else {"termination_height": "env.early_termination is false"}


EFFORT = "msk_ray.envs.limited_body:effort"
JOINT_LIMIT = Cost(
    "joint_limit",
    0.0,
    "msk_ray.envs.limited_body:joint_limit",
    needs=("joint_limit_epochs",),
    schedule=LimitedSettings.joint_limit_share,
    optional=True,
)
