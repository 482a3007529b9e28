"""Share arrays and streams between torch and Warp."""

import torch
import warp as wp
from torch import Tensor

from msk_ray.physics import WorldBatch
from msk_ray.simulation.backward import StepState


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
    return wp.stream_from_torch(torch.cuda.current_stream(device))


class BatchTensors:
    """Torch views of a batch's state arrays."""

    def __init__(self, batch: WorldBatch) -> None:
        data = batch.data
        self._ctrl = wp.to_torch(data.ctrl, requires_grad=False)
        self._state = StepState(*(wp.to_torch(a, requires_grad=False) for a in (data.qpos, data.qvel, data.act)))

    def load(self, ctrl: Tensor, start: StepState) -> None:
        """Copy an env step's inputs in: ctrl (W, nu) and the state before it."""
        with torch.no_grad():
            self._ctrl.copy_(ctrl)
            for view, value in zip(self._state, start, strict=True):
                view.copy_(value)

    def read(self) -> StepState:
        """Copies of the state arrays."""
        return StepState(*(view.clone() for view in self._state))
