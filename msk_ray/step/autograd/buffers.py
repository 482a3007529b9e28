"""Share arrays and streams between torch and Warp."""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from msk_ray.step.autograd.backward import ExternalForces, StepState
from msk_ray.step.forward import WorldBatch, joined_stream


def device_of(batch: WorldBatch) -> torch.device:
    """The batch's device as a torch device."""
    return torch.device(str(batch.device))


def wait_for(device: torch.device) -> None:
    """Wait until torch's current stream on `device` has finished its work."""
    if device.type == "cuda":
        torch.cuda.current_stream(device).synchronize()


def stream_of(device: torch.device) -> wp.Stream | None:
    """The Warp view of torch's current stream, so that both libraries' work stays in one order."""
    if device.type != "cuda":
        return None
    return joined_stream() or wp.stream_from_torch(torch.cuda.current_stream(device))


def applied_of(data: Any) -> ExternalForces:
    """Torch views of the applied forces of a mujoco_warp.Data."""
    return ExternalForces(*(wp.to_torch(a, requires_grad=False) for a in (data.qfrc_applied, data.xfrc_applied)))


class BatchTensors:
    """Torch views of a batch's state arrays."""

    def __init__(self, batch: WorldBatch) -> None:
        data = batch.data
        self._ctrl = wp.to_torch(data.ctrl, requires_grad=False)
        self._state = StepState(*(wp.to_torch(a, requires_grad=False) for a in (data.qpos, data.qvel, data.act)))
        self._applied = applied_of(data)
        self._pushed = False

    def load(self, ctrl: Tensor, start: StepState, applied: ExternalForces | None = None) -> None:
        """Copy an env step's inputs in: ctrl (W, nu), the state before it, and applied forces if it has some."""
        with torch.no_grad():
            self._ctrl.copy_(ctrl)
            for view, value in zip(self._state, start, strict=True):
                view.copy_(value)
            if applied is not None:
                for view, value in zip(self._applied, applied, strict=True):
                    view.copy_(value)
            elif self._pushed:  # the forces of an earlier step
                for view in self._applied:
                    view.zero_()
            self._pushed = applied is not None

    def read(self) -> StepState:
        """Copies of the state arrays."""
        return StepState(*(view.clone() for view in self._state))
