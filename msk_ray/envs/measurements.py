"""What environments measure of a state, each quantity computed once: frames, tendons, sensors, contacts and the ground.

How each is computed is in `step.autograd`, in a file of its own.

Axes: W worlds.
"""

from collections import deque
from collections.abc import Callable, Hashable
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from msk_ray.errors import ConfigError
from msk_ray.step import Simulation, StepState
from msk_ray.step.autograd.contact_state import Contact, ContactQueries
from msk_ray.step.autograd.ground import Ground
from msk_ray.step.autograd.kinematics import Frames, Kinematics, Names, as_named
from msk_ray.step.autograd.sensors import Readings, Sensors
from msk_ray.step.autograd.tendon_lengths import Tendons
from msk_ray.step.forward.contact_watch import FIGURES

Quantity = TypeVar("Quantity")


class Measurements:
    """Measures states of a simulation, and keeps each quantity for the two states that were measured last.

    Contact forces and the readings of some sensors belong to the step that led to a state. They have no gradient, and
    are 0 in a world that diverged.

    Args:
        sim: the simulation.
        owner: name of the environment's class, for messages.
        kinematics, tendons, ground: replacements for the simulation's own, such as exact ones in float64.

    Attributes:
        ignore_contact_forces: whether everything that belongs to a step reads 0, for states that no step led to and for
            comparisons of gradients.
    """

    def __init__(
        self,
        sim: Simulation,
        owner: str,
        kinematics: Kinematics | None = None,
        tendons: Tendons | None = None,
        ground: Ground | None = None,
    ) -> None:
        self._sim, self._owner = sim, owner
        self._replacements = kinematics, tendons, ground
        self._step: tuple[StepState, Tensor] | None = None
        self._measured: dict[Hashable, deque[tuple[object, bool, Any]]] = {}
        self.ignore_contact_forces = False

    def begin(self, reached: StepState, diverged: Tensor) -> None:
        """Note that a step led to the state `reached`, and in which worlds it `diverged`, (W,) bool."""
        self._step = reached, diverged

    def forget(self) -> None:
        """Drop all kept states, and with them their graphs."""
        self._step = None
        self._measured = {}

    def once(self, what: Hashable, state: object, measure: Callable[[], Quantity]) -> Quantity:
        """The result of `measure` for `state`, of the physics or of the worlds, kept under the key `what`.

        Two are kept, because a step goes back and forth between the state that it starts from and the one it reaches.
        """
        grad = torch.is_grad_enabled()
        kept = self._measured.setdefault(what, deque(maxlen=2))
        for measured, with_grad, result in kept:
            if measured is state and with_grad == grad:
                found: Quantity = result
                return found
        new = measure()
        kept.append((state, grad, new))
        return new

    def frames(self, state: StepState) -> Frames:
        """As `Env.frames`."""
        return self.once("frames", state, lambda: self._kinematics(state.qpos, state.qvel))

    def tendons(self, state: StepState) -> tuple[Tensor, Tensor]:
        """As `Env.tendons`."""
        return self.once("tendons", state, lambda: self._tendons(state.qpos, state.qvel))

    def contact_forces(self, state: StepState, geom: Names) -> Tensor:
        """As `Env.contact_forces`."""
        if self.ignore_contact_forces:
            return torch.zeros_like(self.frames(state).geom_position(geom))
        diverged = self._diverged_in_step_to(state, "contact forces")
        force = self.once("contact_forces", state, self._sim.contact_forces)
        chosen = as_named(force[:, self._kinematics.indices("geom", geom)], geom)
        return chosen.masked_fill(diverged.view(-1, *[1] * (chosen.dim() - 1)), 0.0)

    def contact(self, state: StepState, names: Names, kind: str, against: Names, by: str) -> Contact:
        """As `Env.contact`."""
        query = self._contact_queries(names, kind, against, by)
        if self.ignore_contact_forces:
            self._sim.measure_contacts(query)
            shape = (self._sim.substeps, self._sim.nworld, len(query.primary), FIGURES)
            return Contact.of(torch.zeros(shape, device=self._sim.device))
        diverged = self._diverged_in_step_to(state, "contacts")
        return self.once(query, state, lambda: self._sim.contacts(query)).without(diverged)

    def sensors(self, state: StepState) -> Readings:
        """As `Env.sensors`."""
        frames, tendons = lambda: self.frames(state), lambda: self.tendons(state)
        return self.once(
            "sensors",
            state,
            lambda: Readings(self._sensors, state.qpos, state.qvel, frames, tendons, lambda: self._sensordata(state)),
        )

    @cached_property
    def ground(self) -> Ground:
        """As `Env.ground`."""
        return self._replacements[2] or Ground(self._sim.batch)

    @cached_property
    def _kinematics(self) -> Kinematics:
        return self._replacements[0] or Kinematics(self._sim.batch)

    @cached_property
    def _tendons(self) -> Tendons:
        return self._replacements[1] or Tendons(self._sim.batch)

    @cached_property
    def _contact_queries(self) -> ContactQueries:
        return ContactQueries(self._kinematics)

    @cached_property
    def _sensors(self) -> Sensors:
        return Sensors(self._kinematics, lambda: self._tendons)

    def _sensordata(self, state: StepState) -> Tensor:
        if self.ignore_contact_forces:
            self._sim.measure_sensors()
            return torch.zeros((self._sim.nworld, self._sim.model.nsensordata), device=self._sim.device)
        diverged = self._diverged_in_step_to(state, "sensors of forces and accelerations")
        return self._sim.sensordata().masked_fill(diverged[:, None], 0.0)

    def _diverged_in_step_to(self, state: StepState, what: str) -> Tensor:
        """The worlds that diverged in the step that led to `state`, (W,) bool.

        Raises:
            ConfigError: no step led to this state; the message says where `what` can be used.
        """
        if self._step is None or self._step[0] is not state:
            raise ConfigError(
                f"{self._owner}: {what} belong to a step, not to a state: use them in "
                "remember, reward_terms, fell or outcome_terms, not in observe"
            )
        return self._step[1]
