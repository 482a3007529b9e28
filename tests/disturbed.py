"""Every disturbance that CartPole can have."""

from typing import Any

DISTURBANCES: dict[str, Any] = {
    "observation_noise": {"cart_*": {"uniform": 0.5}, "pole_rate": {"normal": 0.2}},
    "observation_bias": {"pole_angle_*": {"uniform": 0.1}},
    "observation_delay": [0, 2],
    "control_delay": [1, 3],
    "control_delay_substeps": [0, 2],
    "push": {"every": [0.02, 0.1], "velocity": {"slider": [0.5]}},
}
