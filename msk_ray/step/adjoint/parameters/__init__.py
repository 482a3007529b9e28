"""Gradients of a substep by parameters of the model, launched only if they are asked for.

A law whose potential holds parameters adds their gradients in its own kernel (`LAW_GRADIENTS`); the families here have
kernels of their own, one file each.
"""

import itertools
from collections.abc import Iterable
from typing import Any

import warp as wp

from msk_ray.step.adjoint.groups import GeomGradients, Substep, TimestepGradient
from msk_ray.step.adjoint.laws.actuators import ActuatorGradients
from msk_ray.step.adjoint.laws.scalar_rows import RowGradients
from msk_ray.step.adjoint.laws.tendon_paths import SiteGradients
from msk_ray.step.adjoint.laws.tendons import TendonGradients
from msk_ray.step.adjoint.parameters.absent_friction import AbsentFrictionFamily
from msk_ray.step.adjoint.parameters.base import GradientBuffer, ParameterFamily
from msk_ray.step.adjoint.parameters.contacts import MaterialFamily
from msk_ray.step.adjoint.parameters.gears import GearFamily
from msk_ray.step.adjoint.parameters.geoms import GeomFamily
from msk_ray.step.adjoint.parameters.inertia import InertiaFamily
from msk_ray.step.adjoint.parameters.joints import JointFamily
from msk_ray.step.adjoint.parameters.timestep import TimestepFamily
from msk_ray.step.adjoint.step import StepAdjoint
from msk_ray.step.forward.parameters import PARAMETERS

FAMILIES: tuple[type[ParameterFamily], ...] = (
    *(TimestepFamily, InertiaFamily, JointFamily, AbsentFrictionFamily, MaterialFamily, GeomFamily),
    GearFamily,
)
"""The families that have launches of their own, in their order."""
LAW_GRADIENTS: tuple[Any, ...] = (
    ActuatorGradients,
    RowGradients,
    TendonGradients,
    SiteGradients,
    GeomGradients,
    TimestepGradient,
)
"""Groups of gradients to which laws add while they are launched for the state."""
_LANES = 3
"""CUDA streams beside the main one that the families share: each fills a small part of a GPU, and none reads what
another writes."""


class ParameterAdjoint:
    """Buffers and launches of the gradients of some parameters, beside a `StepAdjoint`.

    Attributes:
        rows: gradients of every substep since `start` together, (W, numbers of a world); those of quaternions in raw
            coordinates.
        columns: by name, where a parameter's are in a row.
        gradients: the groups that laws add to, by their types.
    """

    def __init__(self, adjoint: StepAdjoint, names: Iterable[str]) -> None:
        work = adjoint.work
        fields = {name: PARAMETERS[name].field for name in names}
        asked = set(fields.values())
        chosen = [s for s in FAMILIES if any(not asked.isdisjoint(kind.vars) for kind in s.kinds)]
        with wp.ScopedDevice(work.device):
            kinds = dict.fromkeys(kind for family in chosen for kind in family.kinds)
            kinds |= dict.fromkeys(kind for kind in LAW_GRADIENTS if not asked.isdisjoint(kind.vars))
            self._buffer = GradientBuffer(kinds, work.model, work.nworld)
            self._families = [family(adjoint, self._buffer.groups) for family in chosen if family.applies(adjoint)]
            self._lanes = [wp.Stream(work.device) for _ in range(_LANES)] if work.device.is_cuda else []
        self._device = work.device
        self.rows: wp.array = self._buffer.rows
        self.gradients = self._buffer.groups
        self.columns = {name: self._buffer.columns[field] for name, field in fields.items()}

    def start(self) -> None:
        """Launch the start of an env step's pullback."""
        self._buffer.clear()

    def launch_first(self, at: Substep, qvel_next: wp.array) -> None:
        """Launch what comes before the pullback of a substep."""
        for family in self._families:
            family.launch_first(at, qvel_next)

    def launch(self, at: Substep) -> None:
        """Launch what one substep adds, when its cotangents are there; what is launched after it waits for all."""
        if not self._lanes:
            for family in self._families:
                family.launch(at)
            return
        main = wp.get_stream(self._device)
        for lane in self._lanes:
            lane.wait_stream(main)
        for family, lane in zip(self._families, itertools.cycle((main, *self._lanes))):
            with wp.ScopedStream(lane, sync_enter=False):
                family.launch(at)
        for lane in self._lanes:
            main.wait_stream(lane)
