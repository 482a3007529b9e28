"""The reference against derivatives worked out by hand."""

import mujoco
import numpy as np
import pytest
from small_models import FILTERED, ant_xml, ball_on_plane, slide_model

from msk_ray.errors import SimulationError
from msk_ray.step.check import Oracle, Point, make_states

H = 0.01
MASS, GAIN = 2.0, 3.0
EXACT = {"rtol": 1e-7, "atol": 1e-8}


def point(ctrl=(), qpos=(), qvel=(), act=()) -> Point:
    return Point(*(np.asarray(value, dtype=float) for value in (ctrl, qpos, qvel, act)))


@pytest.mark.parametrize("substeps", [1, 5])
def test_point_mass(substeps):
    # v' = v + N h g u/m ;  q' = q + N h v + h² g u/m · N(N+1)/2
    line = Oracle(slide_model(), substeps).linearize(point([0.3], [0.7], [-1.2]))
    n, pull = substeps, GAIN / MASS
    np.testing.assert_allclose(line.jacobian["ctrl"], [[H**2 * pull * n * (n + 1) / 2], [n * H * pull]], **EXACT)
    np.testing.assert_allclose(line.jacobian["qpos"], [[1.0], [0.0]], **EXACT)
    np.testing.assert_allclose(line.jacobian["qvel"], [[n * H], [1.0]], **EXACT)
    assert "act" not in line.jacobian
    np.testing.assert_allclose(line.end.qvel, -1.2 + n * H * pull * 0.3)


def test_damping_is_implicit():
    # Euler integrates damping implicitly: v' = v + h (u − b v)/(m + h b)
    damping = 50.0
    line = Oracle(slide_model(damping), 1).linearize(point([0.3], [0.0], [1.0]))
    slope = 1.0 - H * damping / (MASS + H * damping)
    np.testing.assert_allclose(line.jacobian["qvel"], [[H * slope], [slope]], **EXACT)


def test_activation_filter():
    # act' = act + h (u − act)/τ, and the force of this step comes from act: v' = v + h g act/m
    line = Oracle(slide_model(actuator=FILTERED), 1).linearize(point([0.5], [0.0], [0.0], [0.2]))
    rate = H / 0.05
    np.testing.assert_allclose(line.jacobian["ctrl"], [[0.0], [0.0], [rate]], **EXACT)
    pull = H * GAIN / MASS
    np.testing.assert_allclose(line.jacobian["act"], [[H * pull], [pull], [1.0 - rate]], **EXACT)


def test_spinning_free_body():
    """An isotropic body keeps ω: q exp(δ) exp(hω) = q exp(hω) exp(R(hω)ᵀ δ), so ∂q'/∂q is R(hω)ᵀ on rotations."""
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
          <body><freejoint/><geom type="sphere" size=".1"/></body>
        </worldbody></mujoco>""")
    spin = np.array([3.0, -5.0, 40.0])
    quat = np.array([0.5, -0.1, 0.7, 0.2])
    quat /= np.linalg.norm(quat)
    line = Oracle(model, 1).linearize(point([], [1.0, 2.0, 3.0, *quat], [0.1, 0.2, 0.3, *spin]))

    turn, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(turn, spin / np.linalg.norm(spin), H * np.linalg.norm(spin))
    mujoco.mju_quat2Mat(matrix, turn)
    expected = np.zeros((12, 6))
    expected[:3, :3] = np.eye(3)
    expected[3:6, 3:6] = matrix.reshape(3, 3).T
    np.testing.assert_allclose(line.jacobian["qpos"], expected, rtol=0, atol=1e-7)
    np.testing.assert_allclose(line.jacobian["qvel"][:3, :3], H * np.eye(3), rtol=0, atol=1e-9)


def test_quaternion_gradient_ignores_the_way_it_is_written():
    """q and −q are one rotation: the same Jacobian."""
    oracle = Oracle(ball_on_plane(), 3)
    quat = np.array([0.5, 0.5, -0.5, 0.5])
    lines = [oracle.linearize(point([], [0, 0, 0.5, *(sign * quat)], [1, 2, 3, 4, 5, 6])) for sign in (1.0, -1.0)]
    np.testing.assert_allclose(lines[0].jacobian["qpos"], lines[1].jacobian["qpos"], atol=1e-7)


def test_pull_back_is_the_transpose():
    oracle = Oracle(mujoco.MjModel.from_xml_string(ant_xml("elliptic")), 4)
    model = oracle.model
    start = make_states(model, "contact", 1, seed=3)[0]
    line = oracle.linearize(start)
    rng = np.random.default_rng(0)
    cotangent, direction = rng.standard_normal(2 * model.nv), rng.standard_normal(model.nv)
    moved = [Point(start.ctrl, start.qpos, start.qvel + s * 1e-5 * direction, start.act) for s in (1, -1)]
    rise = [cotangent @ oracle.difference(line.end, oracle.step(p)) for p in moved]
    assert line.pull_back(cotangent)["qvel"] @ direction == pytest.approx((rise[0] - rise[1]) / 2e-5, rel=1e-6)


def test_step_is_pure_and_leaves_the_model_alone():
    model = mujoco.MjModel.from_xml_string(ant_xml("pyramidal"))
    tolerance = model.opt.tolerance
    oracle = Oracle(model, 4)
    first, other = make_states(model, "contact", 2, seed=0)
    before = oracle.step(first)
    oracle.step(other)
    after = oracle.step(first)
    for name in ("qpos", "qvel", "act"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    assert model.opt.tolerance == tolerance


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_reference_in_contact_has_eight_digits(cone):
    model = mujoco.MjModel.from_xml_string(ant_xml(cone))
    oracle = Oracle(model, 16)
    lines = [oracle.linearize(p) for p in make_states(model, "contact", 5, seed=0)]
    assert np.median([max(line.step_disagreement.values()) for line in lines]) < 1e-7


def test_stiff_contact_is_extrapolated():
    """A ball pressed 0.3 mm into default contact, whose impedance changes within 1 mm: against a tenth of the step."""
    model = ball_on_plane()
    oracle = Oracle(model, 1)
    start = point([], [0, 0, 0.1 - 3e-4, 1, 0, 0, 0], [0, 0, -0.01, 0, 0, 0])
    line = oracle.linearize(start)
    assert not line.at_kink(1e-3, 1e-2)
    step = 1e-7
    sides = [oracle.difference(line.end, oracle.step(oracle.displaced(start, "qpos", 2, s))) for s in (step, -step)]
    np.testing.assert_allclose(line.jacobian["qpos"][:, 2], (sides[0] - sides[1]) / (2 * step), rtol=1e-6, atol=1e-7)


def test_kink_through_the_state_is_seen():
    """A control on its bound: both central differences say half the slope, the one-sided ones 0 and all of it."""
    line = Oracle(slide_model(), 1).linearize(point([1.0], [0.0], [0.0]))
    assert line.step_disagreement["ctrl"] < 1e-6
    assert line.side_disagreement["ctrl"] == pytest.approx(2.0)
    assert line.at_kink(1e-3, 1e-2)


def test_kink_beside_the_state_is_seen():
    """A ball falling, 4 µm above its contact: only the wider difference reaches the touch."""
    model = ball_on_plane()
    line = Oracle(model, 1).linearize(point([], [0, 0, 0.1 + 4e-6, 1, 0, 0, 0], [0, 0, -1.0, 0, 0, 0]))
    assert line.step_disagreement["qpos"] > 1e-2
    assert line.at_kink(1e-3, 1e-2)


def test_smooth_state_is_no_kink():
    line = Oracle(slide_model(50.0), 4).linearize(point([0.5], [0.0], [1.0]))
    assert not line.at_kink(1e-3, 1e-2)


def test_divergence_is_an_error():
    model = slide_model()
    model.dof_damping[0] = 0.0
    oracle = Oracle(model, 2)
    with pytest.raises(SimulationError, match="diverged"):
        oracle.step(point([0.0], [0.0], [1e12]))
    # and the next step is not spoilt by it
    assert np.isfinite(oracle.step(point([0.0], [0.0], [1.0])).qpos[0])
