"""Kernels compiled before their first launch: which ones, what that leaves alone, and how it is reported."""

import threading
from collections.abc import Iterator

import mujoco
import pytest
import torch
import warp as wp

from msk_ray.step import Simulation
from msk_ray.step.forward import compilation, compile_kernels, on_compiling

CPU = "cpu"


@wp.kernel(module="unique", enable_backward=False)
def add_one(x: wp.array[float]):
    i = wp.tid()
    x[i] = x[i] + 1.0


@wp.kernel(module="unique", enable_backward=False)
def double(x: wp.array[float]):
    i = wp.tid()
    x[i] = 2.0 * x[i]


@wp.kernel(module="unique", enable_backward=False)
def add_one_or_two(x: wp.array[float]):
    i = wp.tid()
    if x[i] > 0.0:
        x[i] = x[i] + 1.0
    else:
        x[i] = x[i] + 2.0


@wp.kernel(module="unique", enable_backward=False)
def of_any_type(x: wp.array[wp.Float]):
    i = wp.tid()
    x[i] = x[i] + x.dtype(1.0)


@pytest.fixture
def reports(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[int, int]]]:
    """What is reported in a process that has compiled nothing yet."""
    monkeypatch.setattr(compilation, "_ready", set())
    monkeypatch.setattr(compilation, "_done", 0)
    calls: list[tuple[int, int]] = []
    on_compiling(lambda done, total: calls.append((done, total)))
    yield calls
    on_compiling(None)


def ones() -> wp.array:
    return wp.ones(3, dtype=float, device=CPU)


def test_each_kernel_is_compiled_once_and_none_is_launched(reports: list[tuple[int, int]]) -> None:
    x, y = ones(), ones()

    def work() -> None:
        wp.copy(y, x)
        wp.launch(add_one, dim=3, inputs=[x], device=CPU)
        wp.launch(add_one, 3, [x], device=CPU)
        wp.capture_while(wp.zeros(1, dtype=int, device=CPU), lambda: wp.launch(double, dim=(3, 1), inputs=[x]))

    x.fill_(5.0)
    compile_kernels(wp.get_device(CPU), work)
    assert x.numpy().tolist() == [5.0] * 3
    assert y.numpy().tolist() == [1.0] * 3
    assert reports == [(0, 2), (1, 2), (2, 2)]
    compile_kernels(wp.get_device(CPU), work)
    assert len(reports) == 3  # all are ready
    wp.launch(add_one, dim=3, inputs=[x], device=CPU)
    assert x.numpy().tolist() == [6.0] * 3


def test_both_branches_are_compiled_and_a_launch_of_no_thread_is_not(reports: list[tuple[int, int]]) -> None:
    x, condition = ones(), wp.zeros(1, dtype=int, device=CPU)
    launch = lambda kernel: lambda: wp.launch(kernel, dim=3, inputs=[x], device=CPU)  # noqa: E731
    compile_kernels(wp.get_device(CPU), lambda: wp.launch(add_one, dim=(3, 0), inputs=[x], device=CPU))
    assert reports == []
    compile_kernels(wp.get_device(CPU), lambda: wp.capture_if(condition, launch(add_one), launch(double)))
    assert reports[-1] == (2, 2)


def test_a_generic_kernel_waits_for_its_launch(reports: list[tuple[int, int]]) -> None:
    x = ones()
    work = lambda: wp.launch(of_any_type, dim=3, inputs=[x], device=CPU)  # noqa: E731
    compile_kernels(wp.get_device(CPU), work)
    assert reports == []
    work()
    assert x.numpy().tolist() == [2.0] * 3


def test_the_longest_is_compiled_first(reports: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch) -> None:
    started = []
    monkeypatch.setattr(compilation, "_MOST_THREADS", 1)
    monkeypatch.setattr(compilation, "_load", lambda device, variant: started.append(variant[0]))
    x = ones()

    def work() -> None:
        wp.launch(double, dim=3, inputs=[x], device=CPU)
        wp.launch(add_one_or_two, dim=3, inputs=[x], device=CPU)

    compile_kernels(wp.get_device(CPU), work)
    assert started == [add_one_or_two.module, double.module]


def test_other_threads_launch_meanwhile() -> None:
    x = ones()

    def work() -> None:
        other = threading.Thread(target=lambda: wp.launch(add_one, dim=3, inputs=[x], device=CPU))
        other.start()
        other.join()

    compile_kernels(wp.get_device(CPU), work)
    assert x.numpy().tolist() == [2.0] * 3


def test_launching_works_again_after_an_error() -> None:
    x = ones()

    def work() -> None:
        wp.launch(double, dim=3, inputs=[x], device=CPU)
        raise RuntimeError("of the work")

    with pytest.raises(RuntimeError, match="of the work"):
        compile_kernels(wp.get_device(CPU), work)
    wp.launch(double, dim=3, inputs=[x], device=CPU)
    assert x.numpy().tolist() == [2.0] * 3


def test_a_kernel_that_does_not_compile_raises(reports: list[tuple[int, int]]) -> None:
    @wp.kernel(enable_backward=False, module=wp.Module("broken"))
    def broken(x: wp.array[float]):
        x[0] = wp.no_such_function(x[0])

    with pytest.raises(Exception, match="no_such_function"):
        compile_kernels(wp.get_device(CPU), lambda: wp.launch(broken, dim=1, inputs=[ones()], device=CPU))
    assert reports == [(0, 1)]


@pytest.mark.parametrize("device", [CPU, pytest.param("cuda:0", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("mode", ["tape_per_substep", "tape_all", "hybrid"])
def test_a_simulation_compiles_its_step_and_its_gradient_together(
    mode: str, device: str, reports: list[tuple[int, int]]
) -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="j" type="slide"/><geom size="0.1"/></body></worldbody>
        <actuator><motor joint="j"/></actuator></mujoco>"""
    )
    sim = Simulation(model, nworld=2, substeps=2, backward=mode, device=device)
    assert reports
    done, total = reports[-1]
    assert done == total == reports[0][1]  # all at once
    ctrl = torch.zeros(2, 1, device=device, requires_grad=True)
    sim.step(ctrl, *sim.initial_state()).qpos.sum().backward()
    assert reports[-1] == (done, total)
