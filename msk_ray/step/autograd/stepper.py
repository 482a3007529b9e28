"""Env steps of tensors, on recorded graphs whose buffers grow if a step needs more."""

from collections.abc import Iterable, Mapping

import warp as wp
from torch import Tensor

from msk_ray.step.autograd.backward import Applied, Backward, StepState
from msk_ray.step.autograd.buffers import BatchTensors, device_of, stream_of, wait_for
from msk_ray.step.autograd.parameters import ParameterTensors
from msk_ray.step.forward import Graph, WorldBatch, joined_stream
from msk_ray.step.forward.capacity import Capacity
from msk_ray.step.forward.contact_forces import ContactForces

_NEARLY_FULL = 0.75
"""Share of a buffer in use above which it grows between epochs, before a step needs more."""


class Engine:
    """One batch, the graph of its step and the backward mode attached to it: everything with a fixed size.

    A recorded env step is pulled back by the engine that computed it, even if others have replaced it since.
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
        self._record()
        self._unseen = False
        self._touch: ContactForces | None = None

    def _record(self) -> None:
        """Prepare the step, which runs once for that on CUDA."""
        self._graph = Graph(self._launches, self.batch.device)
        self._limits = self.batch.unrolled_iterations
        for watch in (self.batch.losses, self.batch.iterations):
            watch.read()  # of that run, whose state is nobody's
        if self.backward is not None:
            self.backward.forget()

    def contact_forces(self) -> Tensor:
        """Force of the contacts on every geom [N] in the last substep of the last step, (W, G, 3)."""
        if self._touch is None:
            data = self.batch.data if self.backward is None else self.backward.last_data(self.batch)
            self._touch = ContactForces(self.batch.model, data)
            self._touch_graph = Graph(self._touch.launch, self.batch.device)
        self._touch_graph.replay(stream_of(self.device))
        force: Tensor = wp.to_torch(self._touch.force, requires_grad=False)
        return force.clone()

    def have_parameters(self, values: Mapping[str, Tensor]) -> None:
        """Put these values of the batch's parameters into its model, and its own values for all others, unless they
        were the last that were put there.

        A change that leaves no trace in a tensor's version is not seen, as in everything that autograd keeps.
        """
        self._parameters.hold(values)

    def advance(self, ctrl: Tensor, start: StepState, applied: Applied | None = None) -> StepState:
        """One env step, even if it lost contacts or rows."""
        if self.batch.ordered and self._limits != self.batch.unrolled_iterations and joined_stream() is None:
            self.settle()
            self._record()
        self._buffers.load(ctrl, start, applied)
        self._graph.replay(stream_of(self.device))
        self._unseen = True
        return self._buffers.read()

    def settle(self) -> None:
        """Raise SimulationError if any step so far lost something. Waits for the device, once after each step.

        While steps are being captured, none has run yet, and nothing can be known.
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
        room = self.batch.capacity.at_least(Capacity(1, 1))  # a model that can have none uses none of it
        figures = {
            "solver_limit_share": limited,
            "contacts_share": used.contacts / room.contacts,
            "rows_share": used.rows / room.rows,
        }
        return figures | (self.backward.diagnostics() if self.backward is not None else {}), used


class Stepper:
    """Steps a batch; on CPU, where a loss is known at once, a step that lost something is repeated with larger buffers.

    On CUDA the results of such a step are NaN, and the first call after the device has run the step raises an error, at
    the latest when it is pulled back.

    Attributes:
        engine: the engine that computed the last step.
    """

    def __init__(self, batch: WorldBatch, backward: Backward | None = None) -> None:
        self.engine = Engine(batch, backward)
        self._retired: list[Engine] = []

    def advance(self, ctrl: Tensor, start: StepState, applied: Applied | None = None) -> StepState:
        """The state after one env step under `ctrl` (W, nu) and applied forces.

        Raises:
            SimulationError: a step lost contacts or constraint rows, on CUDA perhaps an earlier one.
            ConfigError: the MjModel was edited.
        """
        self.engine.batch.check_model()
        self.engine.batch.raise_losses()
        end = self.engine.advance(ctrl, start, applied)
        # On CUDA this may be the loss of an earlier step, from which this one started.
        while self.engine.device.type == "cpu" and self.engine.batch.losses.heard():
            self._replace(self.engine.batch.larger())
            end = self.engine.advance(ctrl, start, applied)
        return end

    def reserve(self, wanted: Capacity) -> None:
        """Enlarge the buffers to at least `wanted` per world, as far as they may grow."""
        batch = self.engine.batch
        allowed = batch.growth(wanted)
        if allowed != batch.capacity:
            self._replace(batch.resized(batch.nworld, allowed))

    def open_parameters(self, names: Iterable[str]) -> None:
        """Let the named fields of the model have a value for each world, from the next step on."""
        if not set(names) <= set(self.engine.batch.parameters):
            self._replace(self.engine.batch.with_parameters(names))

    def diagnostics(self) -> dict[str, float]:
        """Diagnostics since the last call, the largest if there were several engines; enlarges buffers that are
        filling.

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
