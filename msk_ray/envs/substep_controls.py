"""Env steps within which the control may change, for controls that are late by a part of a step.

Axes: S substeps, W worlds.
"""

from collections.abc import Mapping
from typing import Any

import mujoco
import torch
from torch import Tensor

from msk_ray.errors import ConfigError
from msk_ray.step import Backward, Simulation, StepState
from msk_ray.step.autograd.contact_state import Contact
from msk_ray.step.autograd.jacobian import Linearization
from msk_ray.step.forward.contact_watch import ContactQuery


class SubstepControls(Simulation):
    """A simulation whose steps take a control for each substep.

    Each substep is a step of its own, so that every backward mode differentiates it; its solver starts cold.

    Args:
        model, nworld, substeps, backward, device, options: as for `Simulation`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        substeps: int,
        backward: Backward | None,
        device: str,
        **options: Any,
    ) -> None:
        super().__init__(model, nworld, 1, backward, device, **options)
        self.substeps = substeps
        self._figures: dict[ContactQuery, Tensor] = {}

    def step(
        self,
        ctrl: Tensor,
        qpos: Tensor,
        qvel: Tensor,
        act: Tensor,
        *,
        qfrc_applied: Tensor | None = None,
        xfrc_applied: Tensor | None = None,
        parameters: Mapping[str, Tensor] | None = None,
    ) -> StepState:
        """As `Simulation.step`, under controls (S, W, nu)."""
        if ctrl.dim() != 3 or len(ctrl) != self.substeps:
            raise ConfigError(
                f"step: ctrl has shape {tuple(ctrl.shape)}, not {(self.substeps, self.nworld, self.model.nu)}: give "
                "one control for each substep"
            )
        state = StepState(qpos, qvel, act)
        figures: dict[ContactQuery, list[Tensor]] = {}
        for control in ctrl:
            state = super().step(
                control, *state, qfrc_applied=qfrc_applied, xfrc_applied=xfrc_applied, parameters=parameters
            )
            for query in self.batch.contacts.queries:
                figures.setdefault(query, []).append(self.engine.contacts(query))
        self._figures = {query: torch.cat(of_substeps) for query, of_substeps in figures.items()}
        return state

    def contacts(self, query: ContactQuery) -> Contact:
        if query not in self._figures:
            raise ConfigError("the last step did not watch these contacts: call measure_contacts() before a step")
        return Contact.of(self._figures[query])

    def linearize(self, *args: Any, **kwargs: Any) -> Linearization:
        raise ConfigError("a step with a control for each substep has no one Jacobian of its control: use Simulation")
