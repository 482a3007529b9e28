"""The differentiable step: batches of MuJoCo Warp worlds whose steps are autograd functions of torch tensors.

A stand-alone library: it needs mujoco, mujoco_warp, warp, numpy and torch, and imports nothing else from `msk_ray`.

| package | contents |
|---|---|
| `forward` | batches of worlds in Warp: buffers, recorded graphs, the fused solver, sums in a fixed order; no torch |
| `adjoint` | the exact pullback of one `mujoco_warp.step`; the formula is at the top of `adjoint/step.py`; no torch |
| `autograd` | `Simulation`, backward modes; kinematics, tendons, sensors, ground: where torch and Warp meet |
| `check` | gradients against float64 central differences of C MuJoCo |
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msk_ray.step.autograd import Backward as Backward
    from msk_ray.step.autograd import Capacity as Capacity
    from msk_ray.step.autograd import FdJacobian as FdJacobian
    from msk_ray.step.autograd import Hybrid as Hybrid
    from msk_ray.step.autograd import InputGradients as InputGradients
    from msk_ray.step.autograd import Linearization as Linearization
    from msk_ray.step.autograd import Simulation as Simulation
    from msk_ray.step.autograd import StepState as StepState
    from msk_ray.step.autograd import TapeAll as TapeAll
    from msk_ray.step.autograd import TapePerSubstep as TapePerSubstep
    from msk_ray.step.autograd import WarpSimStep as WarpSimStep
    from msk_ray.step.autograd import use_device as use_device
    from msk_ray.step.check import GradientCheck as GradientCheck
    from msk_ray.step.check import check_gradients as check_gradients
    from msk_ray.step.errors import SimulationError as SimulationError
    from msk_ray.step.errors import UnsupportedModelError as UnsupportedModelError
    from msk_ray.step.forward import Kernels as Kernels

_HOMES = {
    "autograd": (
        *("Backward", "Capacity", "FdJacobian", "Hybrid", "InputGradients", "Linearization", "Simulation"),
        *("StepState", "TapeAll", "TapePerSubstep", "WarpSimStep", "use_device"),
    ),
    "check": ("GradientCheck", "check_gradients"),
    "errors": ("SimulationError", "UnsupportedModelError"),
    "forward": ("Kernels",),
}

__all__ = sorted(name for names in _HOMES.values() for name in names)


def __getattr__(name: str) -> Any:
    """Load names on first use, so that `forward` and `adjoint` work without torch."""
    for home, names in _HOMES.items():
        if name in names:
            value = getattr(import_module(f"{__name__}.{home}"), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
