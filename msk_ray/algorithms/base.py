"""What the trainer asks of an algorithm."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor


@dataclass(frozen=True)
class EpochResult:
    """What came of one epoch."""

    env_steps: int
    """Env steps simulated, all worlds together."""
    metrics: dict[str, float]
    """For logs, by name; nothing in the program reads them back."""


class Algorithm(Protocol):
    """Learns a policy for one environment, epoch by epoch. Made from a trial's config and its environment."""

    def update(self, epoch: int) -> EpochResult:
        """Train one epoch, counted from 0.

        Raises:
            SimulationError: training cannot go on: a gradient is not finite, or the physics failed.
        """
        ...

    def policy(self, obs: Tensor) -> Tensor:
        """Deterministic actions (W, A) in [-1, 1] for raw observations (W, O), without gradients."""
        ...

    def policy_state_dict(self) -> dict[str, Any]:
        """State of the modules that `policy` uses, by module name."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything a later `load_state_dict` needs to go on exactly, environment state included."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` gave."""
        ...

    def start_from(self, modules: Mapping[str, Any]) -> None:
        """Take networks and statistics from another trial's states, by module name.

        Raises:
            KeyError: a module that the policy needs is not there.
            RuntimeError: a network has another shape.
        """
        ...
