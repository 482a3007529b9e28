"""A stand-in for `Simulation`: one world in C MuJoCo, in float64."""

from collections.abc import Iterator, Mapping

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msk_ray.errors import ConfigError, UnsupportedModelError
from msk_ray.step import Kernels, Simulation, StepState
from msk_ray.step.autograd.contact_state import Contact
from msk_ray.step.forward.contact_watch import FIGURES, ContactQuery
from msk_ray.step.forward.solver_limits import SolverLimits, own_limits


class CSimulation(Simulation):
    """A step, its contacts and sensors, of one world on the CPU, without gradients. The rest is inherited.

    If a step is given the state that the last one returned, it continues from that state in float64.

    Args:
        limits: iteration limits of the solver; None: the model's, but at least 100 and 50.

    Attributes:
        data: MuJoCo's state after the last step.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int, limits: SolverLimits | None = None) -> None:
        super().__init__(model, 1, substeps, None, "cpu", kernels=Kernels(**(limits._asdict() if limits else {})))
        self.data = mujoco.MjData(model)
        self._figures: dict[ContactQuery, list[Tensor]] = {}

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
        """Take one env step; shapes as for `Simulation.step` with W = 1.

        Raises:
            UnsupportedModelError: forces or parameters are given.
        """
        if qfrc_applied is not None or xfrc_applied is not None or parameters is not None:
            raise UnsupportedModelError("a step in C MuJoCo takes no applied forces or parameters: use Simulation")
        data, given = self.data, StepState(qpos, qvel, act)
        if not all(torch.equal(old, new) for old, new in zip(self._state(), given, strict=True)):
            mujoco.mj_resetData(self.model, data)
            data.qpos[:], data.qvel[:], data.act[:] = (part[0].numpy() for part in given)
        data.ctrl[:] = ctrl[0].numpy()
        own = own_limits(self.model)
        self._limit(self.batch.limits)
        self._figures = {query: [] for query in self.batch.contacts.queries}
        for _ in range(self.substeps):
            mujoco.mj_step(self.model, data)
            for query, figures in self._figures.items():
                figures.append(self._answer(query))
        self._limit(own)
        return self._state()

    def _limit(self, limits: SolverLimits) -> None:
        self.model.opt.iterations, self.model.opt.ls_iterations = limits

    def _state(self) -> StepState:
        parts = (self.data.qpos, self.data.qvel, self.data.act)
        return StepState(*(torch.tensor(part, dtype=torch.float32)[None] for part in parts))

    def contact_forces(self) -> Tensor:
        """Force of all contacts on every geom in world coordinates [N], shape (1, G, 3), in the last substep of the
        last step."""
        forces = np.zeros((self.model.ngeom, 3))
        for geoms, force in self._contacts():
            for geom, sign in zip(geoms, (-1.0, 1.0), strict=True):
                if geom >= 0:
                    forces[geom] += sign * force
        return torch.tensor(forces, dtype=torch.float32)[None]

    def _contacts(self) -> Iterator[tuple[tuple[int, int], NDArray[np.float64]]]:
        """Both geoms of each contact with constraint rows, and the force [N] on the second in world coordinates."""
        wrench = np.zeros(6)
        for index, contact in enumerate(self.data.contact):
            if contact.efc_address < 0:
                continue
            mujoco.mj_contactForce(self.model, self.data, index, wrench)
            # Rows of the frame are its axes.
            yield (int(contact.geom[0]), int(contact.geom[1])), contact.frame.reshape(3, 3).T @ wrench[:3]

    def sensordata(self) -> Tensor:
        """Readings of all sensors in the last substep of the last step, shape (1, nsensordata)."""
        return torch.tensor(self.data.sensordata, dtype=torch.float32)[None]

    def contacts(self, query: ContactQuery) -> Contact:
        """Contacts in the substeps of the last step.

        Raises:
            ConfigError: the last step did not watch these.
        """
        if not self._figures.get(query):
            raise ConfigError("the last step did not watch these contacts: call measure_contacts() before a step")
        return Contact.of(torch.stack(self._figures[query]))

    def _answer(self, query: ContactQuery) -> Tensor:
        """Its figures in the last substep, shape (1, n, FIGURES)."""
        figures = np.zeros((1, len(query.primary), FIGURES))
        for (first, second), force in self._contacts():
            for row, primary in zip(figures[0], query.primary, strict=True):
                if first in primary and second in query.secondary:
                    row[:3] -= force
                elif second in primary and first in query.secondary:
                    row[:3] += force
                else:
                    continue
                row[3] += 1.0
                row[4] = max(row[4], np.linalg.norm(force))
        return torch.tensor(figures, dtype=torch.float32)
