"""`TapedStep`: the differentiable env step for plain Warp, recorded on a `wp.Tape`; no torch."""

from typing import NamedTuple

import warp as wp

from msk_ray.step.adjoint import StepAdjoint
from msk_ray.step.adjoint.coverage.check import check_supported
from msk_ray.step.adjoint.stages.substep_pullback import substep_pullback
from msk_ray.step.forward.arrays import add_into
from msk_ray.step.forward.batch import WorldBatch


class WarpState(NamedTuple):
    """Arrays of one side of an env step."""

    qpos: wp.array
    """Generalised positions, shape (W, nq), float32."""
    qvel: wp.array
    """Shape (W, nv)."""
    act: wp.array
    """Shape (W, na)."""


class TapedStep:
    """Steps a batch and, given a tape, records the exact pullback of what it did.

    Example:
        >>> step = TapedStep(WorldBatch(mjm, nworld=64, substeps=4, device="cuda:0"))
        >>> with wp.Tape() as tape:
        ...     for u in controls:
        ...         state = step(u, state, tape)
        ...     wp.launch(loss_kernel, dim=64, inputs=[state.qpos], outputs=[loss])
        >>> tape.backward(loss)
        >>> controls[0].grad

    Args:
        batch: worlds, model and substeps; its Data is overwritten by every step and every pullback.

    Raises:
        UnsupportedModelError: the adjoint does not cover the model.
        SimulationError: by a step or its pullback, a step lost contacts or constraint rows.
        ConfigError: by either, the MjModel was edited.
    """

    def __init__(self, batch: WorldBatch) -> None:
        check_supported(batch.mjm, "TapedStep")
        self._batch = batch
        with wp.ScopedDevice(batch.device):
            self._adjoint = StepAdjoint(batch.mjm, batch.model, batch.data, stages=batch.stages)
            self._substep = substep_pullback(self._adjoint)
            self._raw = wp.zeros((batch.nworld, batch.mjm.nq), dtype=float)

    def __call__(self, ctrl: wp.array, state: WarpState, tape: wp.Tape | None = None) -> WarpState:
        """The state after one env step under `ctrl` (W, nu), in new arrays; inputs that need a gradient keep theirs."""
        batch, data = self._batch, self._batch.data
        batch.check_model()
        batch.raise_losses()
        kept: list[dict[str, wp.array]] = []
        with wp.ScopedDevice(batch.device):
            wp.copy(data.ctrl, ctrl)
            for name, array in state._asdict().items():
                wp.copy(getattr(data, name), array)
            batch.begin_step()
            for k in range(batch.substeps):
                saved = {name: wp.clone(getattr(data, name), requires_grad=False) for name in ("qpos", "qvel", "act")}
                batch.launch_substep(data, k)
                saved["qacc"] = wp.clone(data.qacc, requires_grad=False)
                kept.append(saved)
            batch.end_step(data)
            end = WarpState(*(wp.clone(getattr(data, n), requires_grad=tape is not None) for n in WarpState._fields))
        if not batch.device.is_cuda:
            batch.raise_losses()
        if tape is not None:
            held = wp.clone(ctrl, requires_grad=False)
            arrays = [array for array in (ctrl, *state, *end) if array.requires_grad]
            tape.record_func(lambda: self._pull_back(held, ctrl, state, end, kept), arrays)
        return end

    def _pull_back(
        self, held: wp.array, ctrl: wp.array, start: WarpState, end: WarpState, kept: list[dict[str, wp.array]]
    ) -> None:
        batch, data, adjoint = self._batch, self._batch.data, self._adjoint
        batch.check_model()
        wp.synchronize_device(batch.device)
        batch.raise_losses()
        with wp.ScopedDevice(batch.device):
            wp.copy(data.ctrl, held)
            wp.copy(adjoint.grad_qvel, end.qvel.grad)
            wp.copy(adjoint.grad_act, end.act.grad)
            adjoint.start(end.qpos, end.qpos.grad)
            qvel_next = end.qvel
            for saved in reversed(kept):
                for name, array in saved.items():
                    wp.copy(getattr(data, name), array)
                self._substep.pull_back(data, qvel_next)
                qvel_next = saved["qvel"]
            adjoint.finish(kept[0]["qpos"], self._raw)
            gradients = (adjoint.grad_ctrl, self._raw, adjoint.grad_qvel, adjoint.grad_act)
            for gradient, array in zip(gradients, (ctrl, *start), strict=True):
                if array.requires_grad and array.size:
                    wp.launch(add_into, dim=array.shape, inputs=[gradient], outputs=[array.grad])
