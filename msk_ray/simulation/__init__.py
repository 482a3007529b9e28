"""The differentiable step: the one place where torch and Warp meet."""

from msk_ray.physics.capacity import Capacity
from msk_ray.simulation.backward import Backward, InputGradients, StepState
from msk_ray.simulation.fd_jacobian import FdJacobian
from msk_ray.simulation.hybrid import Hybrid
from msk_ray.simulation.jacobian import Linearization
from msk_ray.simulation.simulation import Simulation, WarpSimStep, use_device
from msk_ray.simulation.tape import TapeAll, TapePerSubstep

__all__ = [
    "Backward",
    "Capacity",
    "FdJacobian",
    "Hybrid",
    "InputGradients",
    "Linearization",
    "Simulation",
    "StepState",
    "TapeAll",
    "TapePerSubstep",
    "WarpSimStep",
    "use_device",
]
