"""The solver of one kernel finds what C MuJoCo finds in float64."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp
from mujoco_warp import OverflowType
from scenes import ant as dropped_ant

from msk_ray.config import load_config
from msk_ray.envs.make import env_class
from msk_ray.errors import ConfigError, SimulationError, UnsupportedModelError
from msk_ray.step import Simulation, check_gradients
from msk_ray.step.forward import Kernels, WorldBatch
from msk_ray.step.forward.capacity import Capacity
from msk_ray.step.forward.fused import FusedSolver, check_fused, newton, scratch
from msk_ray.step.forward.stages import dense

FUSED = Kernels(fused_solver=True)
EVERY_ROW = """
<mujoco>
  <option timestep="0.005" cone="{cone}" impratio="3"/>
  <worldbody>
    <geom type="plane" size="5 5 1" condim="1" friction="0.8 0.1 0.1"/>
    <body pos="0 0 0.198"><freejoint/><geom type="sphere" size="0.2" condim="6" friction="0.8 0.05 0.02"/>
      <body pos="0.25 0 -0.1"><joint name="a" axis="0 1 0" limited="true" range="-5 5" frictionloss="0.1"/>
        <geom type="capsule" size="0.1" fromto="0 0 0 0.3 0 -0.01" condim="4" friction="0.6 0.05 0.02"/></body>
      <body pos="-0.25 0 -0.1"><joint name="b" axis="0 1 0" limited="true" range="-5 5" frictionloss="20"/>
        <geom type="capsule" size="0.1" fromto="0 0 0 -0.3 0 -0.01" condim="3" friction="0.4 0.1 0.1"/></body>
    </body>
    <body pos="0.1 0.35 0.2"><freejoint/><geom type="sphere" size="0.201" condim="1"/></body>
    <body pos="0 0 2"><joint name="c" axis="0 1 0" limited="true" range="14 20"/><geom size="0.1"/></body>
  </worldbody>
  <equality><joint joint1="a" joint2="b" solref="0.05 1"/></equality>
  <tendon><fixed name="t" frictionloss="0.3"><joint joint="a" coef="1"/><joint joint="b" coef="-0.5"/></fixed>
    <fixed name="u" limited="true" range="-1 0.2"><joint joint="c" coef="1"/></fixed></tendon>
</mujoco>
"""


def robot(limbs: tuple[int, ...], options: str) -> mujoco.MjModel:
    """A free body with limbs of so many hinges and capsules."""
    text = ""
    for limb, links in enumerate(limbs):
        inner = ""
        for link in reversed(range(links)):
            axis = ("0 1 0", "0 0 1", "1 0 0")[link % 3]
            inner = (
                f'<body pos="{0.12 if link else 0.1} 0 0"><joint axis="{axis}" range="-50 50" damping=".5" '
                f'armature=".01"/><geom type="capsule" size=".03" fromto="0 0 0 .12 0 0"/>{inner}</body>'
            )
        text += f'<body euler="0 0 {360 * limb / len(limbs):g}">{inner}</body>'
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.005" integrator="implicitfast" {options}/>
        <default><geom contype="0" conaffinity="1" friction="0.8 0.02 0.01"/></default>
        <worldbody><geom type="plane" size="5 5 1" contype="1" conaffinity="0"/>
          <body pos="0 0 .06"><freejoint/><geom size=".06" mass="3"/>{text}</body>
        </worldbody></mujoco>"""
    )


def of_config(name: str) -> mujoco.MjModel:
    config = load_config(f"configs/{name}.yaml")
    return env_class(config.env).build_model(config.env, config.physics)


MODELS: dict[str, Callable[[], mujoco.MjModel]] = {
    "every_row_elliptic": lambda: mujoco.MjModel.from_xml_string(EVERY_ROW.format(cone="elliptic")),
    "robot_18_elliptic": lambda: robot((3, 3, 3, 3), 'cone="elliptic" impratio="10"'),
    "robot_35_pyramidal": lambda: robot((6, 6, 6, 6, 5), 'cone="pyramidal"'),
    "every_row_pyramidal": lambda: mujoco.MjModel.from_xml_string(EVERY_ROW.format(cone="pyramidal")),
    **{
        name: (lambda name=name: of_config(name))  # type: ignore[misc]
        for name in ("ant", "ant_published", "ant_hard_friction", "hopper", "cheetah", "humanoid", "myoleg26")
    },
}


def exact(mjm: mujoco.MjModel) -> mujoco.MjModel:
    """The model with a dense Jacobian, and with a solver that stops where float64 ends."""
    found = dense(mjm)
    # With islands C MuJoCo leaves the states of rows in another order than their forces.
    found.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    found.opt.tolerance, found.opt.ls_tolerance, found.opt.iterations, found.opt.ls_iterations = 1e-12, 1e-4, 200, 100
    return found


def touching(mjm: mujoco.MjModel, seed: int) -> mujoco.MjData:
    """A state after a short fall and a push, and its optimum."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(mjm)
    data.qvel[:] = 0.3 * rng.normal(size=mjm.nv)
    data.ctrl[:] = rng.uniform(-0.3, 0.3, size=mjm.nu)
    for _ in range(60 + 30 * seed):
        mujoco.mj_step(mjm, data)
    data.qvel[:] += 0.3 * rng.normal(size=mjm.nv)
    mujoco.mj_forward(mjm, data)
    return data


def problem(mjm: mujoco.MjModel, state: mujoco.MjData, warm: np.ndarray) -> tuple[Any, Any]:
    """mujoco_warp's model, and Data of two worlds with C MuJoCo's rows, whose results nobody has written yet."""
    state.qacc_warmstart[:] = warm
    model = mjw.put_model(mjm)
    model.opt.tolerance = wp.array([1e-9], dtype=float)
    data = mjw.put_data(mjm, state, nworld=2, njmax=state.nefc + 5)
    for array in (data.qacc, data.qfrc_constraint, data.efc.force, data.efc.Ma):
        array.fill_(np.nan)
    data.efc.state.fill_(-1)
    return model, data


def gap(found: np.ndarray, wanted: np.ndarray) -> float:
    """Largest difference, as a share of the largest number."""
    return float(np.max(np.abs(found - wanted)) / np.max(np.abs(wanted)))


@pytest.mark.parametrize("name", sorted(MODELS))
def test_forces_and_states_are_those_of_float64(name: str) -> None:
    mjm = exact(MODELS[name]())
    check_fused(mjm)
    solve, rng, most = FusedSolver(), np.random.default_rng(0), 0
    for seed in (1, 2, 3):
        state = touching(mjm, seed)
        count = state.nefc
        most = max(most, count)
        inertial = np.zeros(mjm.nv)
        mujoco.mj_mulM(mjm, state, inertial, state.qacc)
        for warm, precision in (
            (state.qacc + 0.1 * rng.normal(size=mjm.nv), 1e-3),
            (np.zeros(mjm.nv), 1e-3),
            # Rows carry the rounding of accelerations that were as wrong.
            (rng.normal(size=mjm.nv) * 30.0 * (1.0 + np.max(np.abs(state.qacc))), 2e-2),
        ):
            model, data = problem(mjm, state, warm)
            solve(model, data)
            for world in range(2):
                assert gap(data.qacc.numpy()[world], state.qacc) < precision
                assert gap(data.efc.Ma.numpy()[world, : mjm.nv], inertial) < precision
                assert gap(data.qfrc_constraint.numpy()[world], state.qfrc_constraint) < 0.1 * precision
                assert gap(data.efc.force.numpy()[world, :count], state.efc_force) < precision
                assert np.array_equal(data.efc.state.numpy()[world, :count], state.efc_state)
                assert data.overflow.numpy()[world] == 0
                assert 1 <= data.solver_niter.numpy()[world] <= 20
    assert most >= 4


def test_the_large_robot_has_more_rows_than_a_warp_has_lanes() -> None:
    mjm = exact(MODELS["robot_35_pyramidal"]())
    assert mjm.nv == 35
    assert touching(mjm, 1).nefc > 100


@pytest.mark.parametrize(
    ("option", "rows", "fused"),
    [
        ("", 0, True),
        ("", 256, True),
        ("", 257, False),
        ('jacobian="sparse"', 0, False),
        ('integrator="RK4"', 0, False),
        ('solver="CG"', 0, False),
    ],
)
def test_kernels_are_chosen_by_size_and_options(option: str, rows: int, fused: bool) -> None:
    """A ball on a plane needs four rows; otherwise by the room that was asked for."""
    mjm = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option {option}/><worldbody><geom type="plane" size="1 1 1"/>
        <body><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    )
    batch = WorldBatch(mjm, 1, 1, "cpu", capacity=Capacity(rows=rows), kernels=Kernels(fused_solver=None))
    assert batch.kernels.fused_solver == fused
    assert batch.capacity.rows == (rows or 4)


def test_every_kind_of_row_is_among_them() -> None:
    kinds, states, dims = set(), set(), set()
    for cone in ("elliptic", "pyramidal"):
        for seed in (1, 2, 3):
            state = touching(exact(MODELS[f"every_row_{cone}"]()), seed)
            kinds |= set(state.efc_type)
            states |= set(state.efc_state)
            dims |= set(state.contact.dim)
    assert kinds == set(range(8))
    assert states == set(range(5))
    assert dims == {1, 3, 4, 6}


def test_limits_of_iterations_stop_it_and_are_reported() -> None:
    mjm = exact(MODELS["every_row_elliptic"]())
    state = touching(mjm, 1)
    warm = 100.0 * np.ones(mjm.nv)
    for iterations, evaluations, taken, bits in (
        (0, 50, 0, 0),
        (1, 50, 1, OverflowType.ITERATIONS),
        (100, 1, None, OverflowType.LS_ITERATIONS),
    ):
        model, data = problem(mjm, state, warm)
        model.opt.iterations, model.opt.ls_iterations = iterations, evaluations
        FusedSolver()(model, data)
        if taken is not None:
            assert data.solver_niter.numpy().tolist() == [taken, taken]
        assert data.overflow.numpy()[0] & int(bits) == int(bits)
        if iterations == 0:
            assert np.array_equal(data.qacc.numpy()[0], warm.astype(np.float32))


def test_a_line_search_of_one_evaluation_lowers_the_cost_all_the_same() -> None:
    mjm = exact(MODELS["every_row_elliptic"]())
    state = touching(mjm, 1)
    model, data = problem(mjm, state, np.zeros(mjm.nv))
    model.opt.ls_iterations = 1
    FusedSolver()(model, data)
    assert gap(data.qacc.numpy()[0], state.qacc) < 1e-2


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_steps_are_those_of_the_package_whatever_the_worlds_beside_them(cone: str) -> None:
    """Three ants at different heights, one of which touches nothing, land and slide."""
    ends = []
    for kernels in (Kernels(), FUSED):
        batch = WorldBatch(dropped_ant(cone), 3, 4, "cpu", kernels=kernels)
        qpos = np.tile(batch.mjm.qpos0, (3, 1)).astype(np.float32)
        qpos[:, 2] = (0.2, 0.26, 5.0)
        batch.data.qpos.assign(qpos)
        batch.data.qvel.assign(np.random.default_rng(0).normal(size=(3, 14)).astype(np.float32))
        counts = []
        for _ in range(6):
            batch.launch_step()
            counts.append(batch.data.nefc.numpy().copy())
        ends.append((batch.data.qpos.numpy().copy(), batch.data.qvel.numpy().copy(), np.array(counts)))
    (qpos, qvel, rows), (own_qpos, own_qvel, own_rows) = ends
    assert len(np.unique(rows)) >= 3
    assert not rows[0, 2]
    assert np.array_equal(rows, own_rows)
    np.testing.assert_allclose(own_qpos, qpos, atol=2e-5)
    np.testing.assert_allclose(own_qvel, qvel, atol=2e-3)


@pytest.mark.parametrize("mode", ["tape_per_substep", "tape_all"])
def test_gradients_of_its_steps_are_those_of_float64(mode: str) -> None:
    sim = Simulation(dropped_ant("elliptic"), 2, 4, mode, tolerance=1e-9, kernels=FUSED)
    report = check_gradients(sim, states=("standing", "contact"))
    assert report.checked >= 4
    assert report.max_rel_error < 1e-3


def test_worlds_may_differ_in_parameters_of_the_model() -> None:
    model = dropped_ant("elliptic")
    qpos = torch.tensor(np.tile(model.qpos0, (2, 1)), dtype=torch.float32)
    qpos[:, 2] = 0.2
    masses = torch.tensor(np.outer([1.0, 3.0], model.body_mass), dtype=torch.float32)
    ends = []
    for kernels in (Kernels(), FUSED):
        sim = Simulation(model, 2, 4, None, kernels=kernels)
        given = (torch.zeros(2, model.nu), qpos, torch.ones(2, model.nv), torch.zeros(2, model.na))
        ends.append(sim.step(*given, parameters={"body_mass": masses}).qvel)
        assert int(sim.batch.data.nefc.numpy().min()) >= 3
    assert float((ends[0][0] - ends[0][1]).abs().max()) > 0.1
    torch.testing.assert_close(ends[1], ends[0], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_rows_that_were_lost_are_reported_and_leave_numbers_behind(cone: str) -> None:
    """Room ends within a contact."""
    sim = Simulation(dropped_ant(cone), 1, 1, None, capacity=Capacity(9, 5), kernels=FUSED)
    qpos = sim.initial_state().qpos
    qpos[:, 2] = 0.02
    with pytest.raises(SimulationError, match=r"execution\.njmax"):
        sim.step(torch.zeros(1, 8), qpos, torch.zeros(1, 14), torch.zeros(1, 0))
    data = sim.batch.data
    assert int(data.nefc.numpy()[0]) > 5
    assert np.isfinite(data.qacc.numpy()).all()
    assert np.isfinite(data.efc.force.numpy()[0, :5]).all()


@pytest.mark.parametrize(
    ("option", "named"),
    [
        ('solver="CG"', "solver CG"),
        ('integrator="RK4"', "integrator RK4"),
        ('noslip_iterations="3"', "noslip"),
    ],
)
def test_models_that_need_another_solver_are_refused_in_one_line(option: str, named: str) -> None:
    mjm = mujoco.MjModel.from_xml_string(f"<mujoco><option {option}/></mujoco>")
    with pytest.raises(UnsupportedModelError, match=rf"{named}.*write execution\.solver_kernels: mujoco_warp") as error:
        WorldBatch(mjm, 1, 1, "cpu", kernels=FUSED)
    assert "\n" not in str(error.value)


def test_models_of_many_degrees_of_freedom_are_refused() -> None:
    bodies = '<body><freejoint/><geom size=".1"/></body>' * 11
    mjm = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    with pytest.raises(UnsupportedModelError, match="66 degrees of freedom, more than 60"):
        WorldBatch(mjm, 1, 1, "cpu", kernels=FUSED)


def test_more_worlds_than_can_be_counted_are_refused_before_memory_is_taken() -> None:
    with pytest.raises(ConfigError, match=r"room for 67108863 worlds.*solver_kernels: mujoco_warp"):
        scratch.make_scratch(2**26, 100, 14, 0)


def test_the_kernel_compiles_for_a_gpu(tmp_path: Path) -> None:
    """Warp brings the compiler along; a mistake in the parts that only a GPU has would be seen nowhere else here."""
    wp.compile_aot_module(newton.solve_world.module, arch=90, module_dir=str(tmp_path), use_ptx=True)
    (found,) = tmp_path.glob("*.ptx")
    text = found.read_text()
    assert ".entry solve_world" in text
    assert "shfl.sync" in text
