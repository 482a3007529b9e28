"""The settings of the two legs with 26 muscles."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import model_validator

from msk_ray.config.physics import ACTIVATION, CONTACTS, SOLVING, STEPPING
from msk_ray.config.sections import NonNegative, Section
from msk_ray.legs.config import LegSettings


class TerrainConfig(Section):
    """Ground of a leg model, made of primitives along +x."""

    kind: Literal["flat", "slope", "steps", "rough", "height_field"] = "flat"
    """`height_field` has no exact gradient: it needs physics.backward=fd_jacobian."""
    slope: float = 0.1
    """Rise over run of `slope`; negative goes down."""
    step_height: NonNegative = 0.05
    """Rise of each of the `steps` [m]."""
    roughness: NonNegative = 0.03
    """Largest height of `rough` strips and `height_field` [m]."""


_TERRAIN_READS: dict[str, tuple[str, ...]] = {
    "flat": (),
    "slope": ("slope",),
    "steps": ("step_height",),
    "rough": ("roughness",),
    "height_field": ("roughness",),
}
"""The settings that each kind of ground reads."""


class MyoLeg26Settings(LegSettings):
    """Legs with 26 Hill-type muscles walk at a target speed, or stand. There are 13 muscles each, under one trunk."""

    reads_physics = STEPPING | SOLVING | CONTACTS | ACTIVATION

    conditions: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        **LegSettings.conditions,
        "uphill": {"env.terrain": {"kind": "slope", "slope": 0.05}},
        "downhill": {"env.terrain": {"kind": "slope", "slope": -0.05}},
        "rough": {"env.terrain": {"kind": "rough", "roughness": 0.02}},
        "weak": {"physics.randomize": {"actuator_gain": {"low": 0.5, "high": 0.5, "only": ["gastroc_r", "soleus_r"]}}},
    }

    terrain: TerrainConfig = TerrainConfig()
    toe_stiffness: NonNegative = 0.0
    """Stiffness of a spring that straightens the toes [N m/rad]; Falisse et al. 2022 (doi:10.1371/journal.pone.0256311)
    have 25. Without it, toes that push-off has bent stay so: their muscles at rest give 0.15 N m at 30°."""
    reset: Literal["stand", "walk", "mixed", "cycle"] = "stand"
    """Initial states near the standing keyframe, the two walking ones, or all three with equal probability; `cycle`:
    near people's posture and speed at the clock's phase (`env.clock`), anywhere in the gait cycle."""
    reset_noise: NonNegative = 0.02
    """Spread of initial joint angles [rad]; velocities, including those of the pelvis, have five times that spread per
    second, which moves the capture point by 3 cm, so that the policy can still balance without a step."""

    @model_validator(mode="after")
    def _starts_with_the_clock(self) -> "MyoLeg26Settings":
        if self.reset == "cycle" and not self.clock:
            raise ValueError("env.reset: cycle starts at the clock's phase: write env.clock: true")
        if self.reset in ("walk", "mixed") and self.clock:
            raise ValueError(f"env.reset: {self.reset} has no phase for env.clock: write env.reset: cycle or stand")
        return self

    def unread(self) -> dict[str, str]:
        unread = super().unread()
        reads = _TERRAIN_READS[self.terrain.kind]
        for name in TerrainConfig.model_fields:
            if name != "kind" and name not in reads:
                unread[f"terrain.{name}"] = f"env.terrain.kind is {self.terrain.kind}"
        return unread
