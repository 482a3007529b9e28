"""The launches of one substep's pullback, apart from the modes that use them."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp
from oracle import relative
from scenes import ant, ant_points
from test_adjoint_features import SCENES, random_points

from msk_ray.step.adjoint import StepAdjoint
from msk_ray.step.adjoint.groups import Multipliers, State, Substep, gather
from msk_ray.step.adjoint.launches import Launcher
from msk_ray.step.adjoint.stages import cholesky, solve
from msk_ray.step.adjoint.stages.recompute import recompute_stages
from msk_ray.step.forward import WorldBatch

_RESULTS = ("live", "grad_qpos", "grad_qvel", "grad_act", "grad_ctrl")
_GROUPS = ("multipliers", "slopes", "fields", "bars", "tendon_bars", "laws", "_bars")


def buffers(holder: object) -> Iterator[tuple[str, wp.array]]:
    """Every floating-point array that the adjoint and its stages hold and the model does not."""
    for name, value in vars(holder).items():
        if isinstance(value, wp.array):
            if value.dtype is not wp.int32:
                yield name, value
        elif name in _GROUPS:
            yield from ((key, array) for key, array in vars(value).items() if isinstance(array, wp.array))
        elif name != "launch":
            for part in value if isinstance(value, list) else [value]:
                if type(part).__module__.startswith("msk_ray.step.adjoint"):
                    yield from buffers(part)


def pulled(model, points, poison: bool) -> dict[str, np.ndarray]:
    """Gradients of one substep under fixed cotangents, with every work buffer first filled with NaN if asked."""
    batch = WorldBatch(model, len(points), 1, "cpu", tolerance=1e-12)
    data = batch.data
    for name in ("qpos", "qvel", "act", "ctrl"):
        getattr(data, name).assign(np.stack([getattr(p, name) for p in points]).astype(np.float32))
    before = {name: wp.clone(getattr(data, name)) for name in ("qpos", "qvel", "act")}
    mjw.step(batch.model, data)
    qvel_next = wp.clone(data.qvel)
    adjoint = StepAdjoint(model, batch.model, data)
    if poison:
        found = {name for name, _ in buffers(adjoint)}
        assert {"lam", "jar", "cacc", "moved", "length", "rhs", "_hessian", "_cacc_sum", "frame"} <= found
        for name, array in buffers(adjoint):
            # Where no tendon, wrap or joint row exists, its buffers are read as they were made.
            if name not in (*_RESULTS, "touch", "_dense"):
                wp.copy(array, wp.full(array.shape, array.dtype(np.nan), dtype=array.dtype))
    rng = np.random.default_rng(0)
    for name in ("grad_qpos", "grad_qvel", "grad_act"):
        array = getattr(adjoint, name)
        array.assign(rng.normal(size=array.shape).astype(np.float32))
    for name, array in before.items():
        wp.copy(getattr(data, name), array)
    recompute_stages(model, batch.model, data, batch.stages)
    adjoint.pull_back(data, qvel_next)
    return {name: np.array(getattr(adjoint, name).numpy()) for name in _RESULTS[1:]}


@pytest.mark.parametrize("name", ["ant", "muscle", "fast_site_tendon", "weld_bodies", "equality_tendon"])
def test_every_buffer_is_written_before_it_is_read(name):
    model = ant("elliptic") if name == "ant" else SCENES[name]()
    points = ant_points(model, 3, seed=1) if name == "ant" else random_points(model, 3, seed=5)
    clean = pulled(model, points, poison=False)
    for key, value in pulled(model, points, poison=True).items():
        assert relative(value, clean[key]) < 1e-6, key


@pytest.mark.parametrize("name", ["ant", "fast_site_tendon"])
def test_large_models_solve_serially_to_the_same(name, monkeypatch):
    model = ant("elliptic") if name == "ant" else SCENES[name]()
    points = ant_points(model, 3, seed=1) if name == "ant" else random_points(model, 3, seed=5)
    tiled = pulled(model, points, poison=False)
    monkeypatch.setattr(cholesky, "TILE_LIMIT", 0)
    for key, value in pulled(model, points, poison=False).items():
        assert relative(value, tiled[key]) < 1e-5, key


def test_the_matrices_compile_for_a_gpu(tmp_path: Path):
    """Their sums have a part of their own there."""
    wp.compile_aot_module(solve.build_matrices.module, arch=90, module_dir=str(tmp_path), use_ptx=True)
    (found,) = tmp_path.glob("*.ptx")
    text = found.read_text()
    assert ".entry build_matrices" in text
    assert "shfl.sync" in text


@wp.kernel(enable_backward=False)
def read_one(damping_in: wp.array2d[wp.vec3]):
    """Takes what `sweep_up` takes under this name."""


@wp.kernel(enable_backward=False)
def read_group(multipliers_in: Multipliers):
    """Takes a group."""


@pytest.mark.parametrize(
    ("kernel", "name", "places"),
    [(read_one, "damping", "work.damping or at.damping"), (read_group, "held", "work.multipliers or at.held")],
)
def test_an_argument_that_two_holders_could_give_is_refused(kernel, name, places):
    """Whatever their order: a new attribute must not take the place of the one that a kernel was written for."""
    model = SCENES["plain"]()
    batch = WorldBatch(model, 1, 1, "cpu")
    work, at = StepAdjoint(model, batch.model, batch.data).work, Substep(batch.data)
    alone = kernel is read_one
    own = work.damping if alone else work.multipliers
    setattr(at, name, own)
    work.launch(kernel, 1, at)  # one object under both names is no question
    setattr(at, name, wp.zeros_like(own) if alone else Multipliers())
    again = Launcher(work)
    with pytest.raises(ValueError, match=f"{kernel.key} may be {places}"):
        again(kernel, 1, at)
    given, named = ((), {"damping": own}) if alone else ((own,), {})
    again(kernel, 1, at, *given, **named)  # what a launch gives counts


def test_a_group_names_the_array_that_has_changed():
    """An upgrade of mujoco_warp that changes an array fails when the adjoint is made, not in its numbers."""
    arrays = {"qpos": wp.zeros((1, 1), dtype=float), "qvel": wp.zeros((1, 1), dtype=float)}
    with pytest.raises(AttributeError, match="qacc"):
        gather(State, SimpleNamespace(**arrays))
    with pytest.raises(TypeError, match=r"'qacc'.*2 dimension"):
        gather(State, SimpleNamespace(**arrays, qacc=wp.zeros(1, dtype=float)))
    with pytest.raises(TypeError, match=r"'qacc'.*float32"):
        gather(State, SimpleNamespace(**arrays, qacc=wp.zeros((1, 1), dtype=int)))


@wp.kernel(enable_backward=False)
def lonely(qpos_in: wp.array2d[float], wind_chill_in: wp.array[float]):
    pass


def test_a_kernel_names_the_argument_that_nothing_has():
    batch = WorldBatch(SCENES["plain"](), 1, 1, "cpu")
    work = StepAdjoint(batch.mjm, batch.model, batch.data).work
    with pytest.raises(AttributeError, match="'wind_chill_in'"):
        work.launch(lonely, 1, Substep(batch.data))
