"""The differentiable step: the one place where torch and Warp meet."""

from msk_ray.step.garbage import lasting_imports

with lasting_imports():
    from msk_ray.step.autograd.backward import Backward, InputGradients, StepState
    from msk_ray.step.autograd.fd_jacobian import FdJacobian
    from msk_ray.step.autograd.hybrid import Hybrid
    from msk_ray.step.autograd.jacobian import Linearization
    from msk_ray.step.autograd.simulation import Simulation, WarpSimStep, use_device
    from msk_ray.step.autograd.tape import TapeAll, TapePerSubstep
    from msk_ray.step.forward.capacity import Capacity

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
