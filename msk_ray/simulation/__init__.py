"""The differentiable step: the one place where torch and Warp meet."""

from msk_ray.simulation.backward import Backward, InputGradients, StepState
from msk_ray.simulation.fd_jacobian import FdJacobian
from msk_ray.simulation.simulation import Simulation, WarpSimStep

__all__ = ["Backward", "FdJacobian", "InputGradients", "Simulation", "StepState", "WarpSimStep"]
