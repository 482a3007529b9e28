"""`hybrid`: gradients of the state from one mode, of the control from another."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from msk_ray.step.autograd.backward import Backward, ExternalForces, InputGradients, Needs, StepState
from msk_ray.step.autograd.tangent import Tangent
from msk_ray.step.forward import WorldBatch


class Hybrid(Backward):
    """Gradients of the state from one mode and of the control from another, for diagnosis.

    Args:
        state: mode for gradients of (qpos, qvel, act). Its `launch_step` runs.
        ctrl: mode for the gradient of ctrl; it must not need its own `launch_step` (fd_jacobian does not).
    """

    name = "hybrid"

    def __init__(self, state: Backward, ctrl: Backward) -> None:
        self.state = state
        self.ctrl = ctrl

    def fresh(self) -> "Hybrid":
        return Hybrid(self.state.fresh(), self.ctrl.fresh())

    def attach(self, batch: WorldBatch) -> None:
        self._splits: dict[int, int] = {}
        self.state.attach(batch)
        self.ctrl.attach(batch)

    def launch_step(self, batch: WorldBatch) -> None:
        self._step_mode().launch_step(batch)

    def pullbacks(self) -> tuple[Callable[[], None], ...]:
        return (*self.state.pullbacks(), *self.ctrl.pullbacks())

    def last_data(self, batch: WorldBatch) -> Any:
        return self._step_mode().last_data(batch)

    def _step_mode(self) -> Backward:
        """The mode whose launches compute the step."""
        own = [m for m in (self.state, self.ctrl) if type(m).launch_step is not Backward.launch_step]
        assert len(own) <= 1, "two modes that each launch the step in their own way cannot be combined"
        return own[0] if own else self.state

    @property
    def covers_applied(self) -> bool:  # type: ignore[override]
        """Whether both modes cover applied forces."""
        return self.state.covers_applied and self.ctrl.covers_applied

    @property
    def covers_parameters(self) -> bool:  # type: ignore[override]
        """Whether the state's mode covers parameters."""
        return self.state.covers_parameters

    def save(
        self, ctrl: Tensor, start: StepState, end: StepState, applied: ExternalForces | None = None
    ) -> tuple[Tensor, ...]:
        forces = () if applied is None else (applied,)
        first, second = (mode.save(ctrl, start, end, *forces) for mode in (self.state, self.ctrl))
        self._splits[len(first) + len(second)] = len(first)
        return (*first, *second)

    def _split(self, saved: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """The tensors saved by each of the two modes."""
        first = self._splits[len(saved)]  # steps with and without applied forces differ in length
        return saved[:first], saved[first:]

    def vjp(self, saved: tuple[Tensor, ...], cotangent: StepState, needs: Needs) -> InputGradients:
        first, second = self._split(saved)
        state = self.state.vjp(first, cotangent, needs._replace(ctrl=False))
        ctrl = self.ctrl.vjp(second, cotangent, Needs(needs.ctrl, False, False, False))
        return state._replace(ctrl=ctrl.ctrl)

    def jacobian(
        self, saved: tuple[Tensor, ...], start: StepState, end: StepState, tangent: Tangent
    ) -> tuple[Tensor, Tensor]:
        first, second = self._split(saved)
        a, _ = self.state.jacobian(first, start, end, tangent)
        _, b = self.ctrl.jacobian(second, start, end, tangent)
        return a, b

    def forget(self) -> None:
        self.state.forget()
        self.ctrl.forget()

    def diagnostics(self) -> dict[str, float]:
        return self.state.diagnostics() | self.ctrl.diagnostics()
