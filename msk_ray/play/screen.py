"""What shows the states of one world while they are simulated."""

import copy
from abc import ABC, abstractmethod

import mujoco
from torch import Tensor

from msk_ray.step import StepState
from msk_ray.visualize.look import Look


class Screen(ABC):
    """Draws a model, in the look of `visualize`.

    Args:
        model: a copy is drawn, because colours are changed and a simulation watches its own.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self.look = Look(self.model)

    @abstractmethod
    def is_open(self) -> bool:
        """Whether anybody may still look."""

    @abstractmethod
    def show(self, state: StepState, control: Tensor) -> None:
        """Draw the first world of a state, and controls (W, nu)."""

    def _take(self, state: StepState, control: Tensor) -> None:
        """Make `data` that of the first world, with its contacts and the colours of its muscles."""
        for name, values in (*state._asdict().items(), ("ctrl", control)):
            getattr(self.data, name)[:] = values[0].cpu().numpy()
        mujoco.mj_forward(self.model, self.data)
        self.look.colour(self.data.act)
