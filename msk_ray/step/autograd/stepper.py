"""Env steps on torch tensors: replays of recorded graphs, whose buffers grow when a step needs more."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import warp as wp
from torch import Tensor

from msk_ray.step.autograd.backward import Backward, ExternalForces, StepState
from msk_ray.step.autograd.buffers import BatchTensors, device_of, stream_of, wait_for
from msk_ray.step.autograd.parameter_tensors import ParameterTensors
from msk_ray.step.errors import ConfigError
from msk_ray.step.forward import Graph, WorldBatch, compile_kernels, joined_stream
from msk_ray.step.forward.capacity import Capacity
from msk_ray.step.forward.contact_forces import ContactForces
from msk_ray.step.forward.contact_watch import ContactQuery

_NEARLY_FULL = 0.75
"""Share of a buffer in use above which `diagnostics` enlarges it, before a step overflows."""


class _Recipe(NamedTuple):
    """What decides the launches of a step, and may change."""

    limits: tuple[int, ...] | None
    measures_sensors: bool
    queries: tuple[ContactQuery, ...]


class Engine:
    """One batch, the graph of its step and the backward mode attached to it: everything with a fixed size.

    The engine that computed an env step also pulls it back, even if another engine has replaced it since.
    """

    def __init__(self, batch: WorldBatch, backward: Backward | None) -> None:
        self.batch = batch
        self.backward = backward
        self.device = device_of(batch)
        if backward is not None:
            backward.attach(batch)
        self._buffers = BatchTensors(batch)
        self._parameters = ParameterTensors(batch)
        self._launches = batch.launch_step if backward is None else lambda: backward.launch_step(batch)
        self._capture()
        self._unseen = False
        self._contact_forces: ContactForces | None = None

    def _capture(self) -> None:
        """Capture the step as a graph. On CUDA this runs the step once."""
        pullbacks = () if self.backward is None else self.backward.pullbacks()
        compile_kernels(self.batch.device, self._launches, *pullbacks)
        self._graph = Graph(self._launches, self.batch.device)
        self._captured = self._recipe()
        for watch in (self.batch.losses, self.batch.iterations):
            watch.read()  # discard what the run for capturing reported
        if self.backward is not None:
            self.backward.forget()

    def _recipe(self) -> _Recipe:
        batch = self.batch
        limits = batch.unrolled_iterations if batch.ordered else None
        return _Recipe(limits, batch.measures_sensors, batch.contacts.queries)

    @property
    def _last_data(self) -> Any:
        """The mujoco_warp.Data of the last substep."""
        return self.batch.data if self.backward is None else self.backward.last_data(self.batch)

    def sensordata(self) -> Tensor:
        """MuJoCo's sensor readings in the last substep of the last step, (W, nsensordata).

        Raises:
            ConfigError: the step did not take them.
        """
        if not self._captured.measures_sensors:
            raise ConfigError("the last step took no readings of sensors: call measure_sensors() before a step")
        readings: Tensor = wp.to_torch(self._last_data.sensordata, requires_grad=False)
        return readings.clone()

    def contacts(self, query: ContactQuery) -> Tensor:
        """Answer to a query about the contacts of the last step, (S, W, n, FIGURES).

        Raises:
            ConfigError: the step did not answer it.
        """
        if query not in self._captured.queries:
            raise ConfigError("the last step did not watch these contacts: call measure_contacts() before a step")
        figures: Tensor = wp.to_torch(self.batch.contacts.figures[query], requires_grad=False)
        return figures.clone()

    def contact_forces(self) -> Tensor:
        """Force of the contacts on every geom [N] in the last substep of the last step, (W, G, 3)."""
        if self._contact_forces is None:
            self._contact_forces = ContactForces(self.batch.model, self._last_data)
            self._forces_graph = Graph(self._contact_forces.launch, self.batch.device)
        self._forces_graph.replay(stream_of(self.device))
        force: Tensor = wp.to_torch(self._contact_forces.force, requires_grad=False)
        return force.clone()

    def set_parameters(self, values: Mapping[str, Tensor]) -> None:
        """Write these values of open parameters into the batch's model, and the model's own values for the others;
        skipped if the same values were written last.

        In-place edits that bypass a tensor's `_version` go unnoticed, as they do in autograd.
        """
        self._parameters.hold(values)

    def replay(self, ctrl: Tensor, start: StepState, applied: ExternalForces | None = None) -> StepState:
        """The state after one env step, even if the step lost contacts or constraint rows."""
        if self._captured != self._recipe() and joined_stream() is None:
            self.settle()
            self._capture()
        self._buffers.load(ctrl, start, applied)
        self._graph.replay(stream_of(self.device))
        self._unseen = True
        return self._buffers.read()

    def settle(self) -> None:
        """Wait for the device, and raise SimulationError if a step so far lost contacts or constraint rows.

        Does nothing while steps are being captured: none of them has run yet.
        """
        if joined_stream() is not None:
            return
        if self._unseen:
            wait_for(self.device)
            self._unseen = False
        self.batch.raise_losses()

    def diagnostics(self) -> tuple[dict[str, float], Capacity]:
        """Diagnostics since the last call, and the largest use of the buffers by a world.

        Raises:
            SimulationError: a step lost contacts or constraint rows.
        """
        self.settle()
        _, limited, used = self.batch.losses.read()
        room = self.batch.capacity.at_least(Capacity(1, 1))  # avoids 0 / 0 in models without contacts
        figures = {
            "solver_limit_share": limited,
            "contacts_share": used.contacts / room.contacts,
            "rows_share": used.rows / room.rows,
        }
        return figures | (self.backward.diagnostics() if self.backward is not None else {}), used


class Stepper:
    """Steps a batch, and handles steps that lost contacts or constraint rows because a buffer was too small.

    On CPU such a step is repeated with larger buffers. On CUDA its results are NaN, and the first call after the device
    has run it raises an error, at the latest its backward pass.

    Attributes:
        engine: the engine that computed the last step.
    """

    def __init__(self, batch: WorldBatch, backward: Backward | None = None) -> None:
        self.engine = Engine(batch, backward)
        self._retired: list[Engine] = []

    def step(
        self,
        ctrl: Tensor,
        start: StepState,
        applied: ExternalForces | None = None,
        parameters: Mapping[str, Tensor] | None = None,
    ) -> StepState:
        """The state after one env step under `ctrl` (W, nu), applied forces and values of open parameters.

        `parameters` None keeps the values of the last call.

        Raises:
            SimulationError: a step lost contacts or constraint rows, on CUDA perhaps an earlier one.
            ConfigError: the MjModel was edited.
        """
        if parameters is not None:
            self.engine.set_parameters(parameters)
        self.engine.batch.check_model()
        self.engine.batch.raise_losses()
        end = self.engine.replay(ctrl, start, applied)
        # On CUDA this may be the loss of an earlier step, from which this one started.
        while self.engine.device.type == "cpu" and self.engine.batch.losses.any_lost():
            self._replace(self.engine.batch.larger())
            end = self.engine.replay(ctrl, start, applied)
        return end

    def reserve(self, wanted: Capacity) -> None:
        """Enlarge the buffers to at least `wanted` per world, up to the limit on their growth."""
        batch = self.engine.batch
        allowed = batch.growth(wanted)
        if allowed != batch.capacity:
            self._replace(batch.resized(batch.nworld, allowed))

    def open_parameters(self, names: Iterable[str]) -> None:
        """Give each world its own value of the named model fields, from the next step on."""
        if not set(names) <= set(self.engine.batch.parameters):
            self._replace(self.engine.batch.with_parameters(names))

    def diagnostics(self) -> dict[str, float]:
        """Diagnostics since the last call, the largest over the engines used since; enlarges buffers that are nearly
        full.

        Raises:
            SimulationError: a step lost contacts or constraint rows.
        """
        batch = self.engine.batch
        batch.check_model(thorough=True)
        figures, used = self.engine.diagnostics()
        for engine in self._retired:
            earlier, _ = engine.diagnostics()
            figures = {name: max(value, earlier[name]) for name, value in figures.items()}
        self._retired.clear()
        now = batch.capacity
        self.reserve(
            Capacity(
                2 * now.contacts if used.contacts > _NEARLY_FULL * now.contacts else now.contacts,
                2 * now.rows if used.rows > _NEARLY_FULL * now.rows else now.rows,
            )
        )
        return figures

    def _replace(self, batch: WorldBatch) -> None:
        old = self.engine
        self.engine = Engine(batch, None if old.backward is None else old.backward.fresh())
        self._retired.append(old)
