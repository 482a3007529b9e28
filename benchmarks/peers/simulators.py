"""Steps of the same model by several differentiable simulators, behind one interface.

Each is imported where it is used: a process has one of them. A slot is one env step of a rollout, which keeps what its
backward pass needs until the next rollout.
"""

from typing import Any, Protocol

import torch
from torch import Tensor


class Steps(Protocol):
    """Env steps of W worlds."""

    nq: int
    nv: int
    nu: int

    def step(self, slot: int, ctrl: Tensor, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """State after env step `slot` of a rollout, differentiable in ctrl (W, nu), qpos (W, nq) and qvel (W, nv)."""


class Ours:
    """msk_ray's Simulation on mujoco_warp from PyPI."""

    def __init__(self, xml: str, nworld: int, substeps: int, slots: int, device: str) -> None:
        import mujoco

        from msk_ray import Simulation

        model = mujoco.MjModel.from_xml_path(xml)
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self._sim = Simulation(model, nworld, substeps, "tape_per_substep", device)
        self._act = torch.zeros((nworld, 0), device=device)

    def step(self, slot: int, ctrl: Tensor, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """One env step."""
        end = self._sim.step(ctrl, qpos, qvel, self._act)
        return end.qpos, end.qvel


class _Slot:
    """One env step of a fork: where it reads its inputs, and how it runs forward and back."""

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    output_bars: tuple[Tensor, ...]
    input_bars: tuple[Tensor, ...]

    def forward(self) -> None:
        """Step from `inputs` to `outputs`."""

    def backward(self) -> None:
        """Pull `output_bars` back to `input_bars`."""


class _ForkStep(torch.autograd.Function):
    """(ctrl, qpos, qvel) to (qpos, qvel) through a slot."""

    @staticmethod
    def forward(ctx: Any, slot: _Slot, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.slot = slot
        for buffer, value in zip(slot.inputs, inputs, strict=True):
            buffer.copy_(value)
        slot.forward()
        return tuple(t.clone() for t in slot.outputs)

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        slot = ctx.slot
        for buffer, value in zip(slot.output_bars, bars, strict=True):
            buffer.copy_(value)
        slot.backward()
        return (None, *(t.clone() for t in slot.input_bars))


class _Fork:
    """Steps in slots."""

    def __init__(self, xml: str, slots: list[_Slot], model: Any) -> None:
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self._slots = slots

    def step(self, slot: int, ctrl: Tensor, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """One env step."""
        after, speed = _ForkStep.apply(self._slots[slot], ctrl, qpos, qvel)
        return after, speed


def _view(array: Any) -> Tensor:
    import warp as wp

    tensor: Tensor = wp.to_torch(array, requires_grad=False)
    return tensor


class _Slot1535(_Slot):
    """Data of every substep; the forward and the backward pass are a CUDA graph each, as its authors intend."""

    def __init__(self, mjw: Any, mjm: Any, m: Any, nworld: int, substeps: int, room: dict[str, int]) -> None:
        import warp as wp

        self._wp, self._mjw, self._m = wp, mjw, m
        self._datas = [mjw.make_data(mjm, nworld=nworld, **room) for _ in range(substeps + 1)]
        for data in self._datas:
            for name in ("qpos", "qvel", "ctrl"):
                getattr(data, name).requires_grad = True
        first, last = self._datas[0], self._datas[-1]
        self.inputs = (_view(first.ctrl), _view(first.qpos), _view(first.qvel))
        self.outputs = (_view(last.qpos), _view(last.qvel))
        self.output_bars = (_view(last.qpos.grad), _view(last.qvel.grad))
        self._ctrl_bar = wp.zeros_like(first.ctrl.grad)
        self.input_bars = (_view(self._ctrl_bar), _view(first.qpos.grad), _view(first.qvel.grad))
        self._context = mjw.create_backward_context(m, first)
        self._graphs: list[Any] = []
        for run in (self._launch_forward, self._launch_backward):
            run()
            if wp.get_device().is_cuda:
                with wp.ScopedCapture() as capture:
                    run()
                self._graphs.append(capture.graph)

    def _launch_forward(self) -> None:
        self._tape = self._wp.Tape()
        first = self._datas[0]
        first.qacc_warmstart.zero_()
        for before, after in zip(self._datas, self._datas[1:], strict=False):
            self._wp.copy(before.ctrl, first.ctrl)
            with self._tape:
                self._mjw.step(self._m, before, after)

    def _launch_backward(self) -> None:
        for data in self._datas[:-1]:
            for name in ("qpos", "qvel", "ctrl"):
                getattr(data, name).grad.zero_()
        with self._mjw.backward_context(self._context):
            self._tape.backward()
        self._ctrl_bar.zero_()
        for data in self._datas[:-1]:
            self._wp.launch(_kernels()["add"], dim=self._ctrl_bar.shape, inputs=[data.ctrl.grad, self._ctrl_bar])

    def forward(self) -> None:
        self._run(0, self._launch_forward)

    def backward(self) -> None:
        self._run(1, self._launch_backward)

    def _run(self, which: int, launches: Any) -> None:
        if self._graphs:
            stream = self._wp.stream_from_torch(torch.cuda.current_stream())
            self._wp.capture_launch(self._graphs[which], stream=stream)
        else:
            launches()


class _Slot1423(_Slot):
    """One Data, stepped under a tape launch by launch: the fork refuses to be captured under a tape."""

    def __init__(self, mjw: Any, mjm: Any, m: Any, nworld: int, substeps: int, room: dict[str, int]) -> None:
        import warp as wp

        self._wp, self._mjw, self._m, self._substeps = wp, mjw, m, substeps
        self._data = mjw.make_diff_data(mjm, nworld=nworld, **room)
        self._start = {name: getattr(self._data, name) for name in ("ctrl", "qpos", "qvel", "qacc_warmstart", "time")}
        self.inputs = tuple(_view(self._start[name]) for name in ("ctrl", "qpos", "qvel"))

    def forward(self) -> None:
        with self._on_stream():
            for name, array in self._start.items():
                setattr(self._data, name, array)
            self._data.qacc_warmstart.zero_()
            self._tape = self._wp.Tape()
            with self._tape:
                for _ in range(self._substeps):
                    self._mjw.step(self._m, self._data)
        self.outputs = (_view(self._data.qpos), _view(self._data.qvel))
        self.output_bars = (_view(self._data.qpos.grad), _view(self._data.qvel.grad))
        self.input_bars = tuple(_view(self._start[name].grad) for name in ("ctrl", "qpos", "qvel"))

    def backward(self) -> None:
        with self._on_stream():
            for name in ("ctrl", "qpos", "qvel"):
                self._start[name].grad.zero_()
            self._tape.backward()

    def _on_stream(self) -> Any:
        wp = self._wp
        if not wp.get_device().is_cuda:
            return wp.ScopedDevice("cpu")
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream()), sync_enter=False)


def fork(kind: str, xml: str, nworld: int, substeps: int, slots: int, device: str) -> _Fork:
    """A fork of mujoco_warp, which must be the package that `mujoco_warp` names."""
    import mujoco
    import mujoco_warp as mjw
    import warp as wp

    wp.set_device(device)
    model = mujoco.MjModel.from_xml_path(xml)
    room = {"nconmax": 25, "njmax": 91}
    if kind == "pr1535":
        mjw.enable_grad()
    m = mjw.put_model(model)
    make = _Slot1535 if kind == "pr1535" else _Slot1423
    return _Fork(xml, [make(mjw, model, m, nworld, substeps, room) for _ in range(slots)], model)


_compiled: dict[str, Any] = {}


def _kernels() -> dict[str, Any]:
    """Kernels of our own, made once Warp is imported."""
    if not _compiled:
        import warp as wp

        @wp.kernel(enable_backward=False)
        def add(a: wp.array2d(dtype=float), out: wp.array2d(dtype=float)):
            i, j = wp.tid()
            out[i, j] += a[i, j]

        _compiled["add"] = add
    return _compiled
