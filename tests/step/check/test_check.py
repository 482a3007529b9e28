"""The comparison: right gradients pass, wrong ones are caught in direction and in magnitude."""

import math

import mujoco
import numpy as np
import pytest
import torch
from needs import slow
from small_models import ant_xml

from msk_ray.errors import ConfigError, SimulationError
from msk_ray.step import FdJacobian, Simulation
from msk_ray.step.autograd.backward import InputGradients
from msk_ray.step.check import STATE_KINDS, GradientCheck, Limits, Oracle, Point, check_gradients
from msk_ray.step.check.check import check_request, compare, forward_mismatch
from msk_ray.step.forward.capacity import Capacity


class Altered(FdJacobian):
    """The gradient with one input's part changed."""

    def __init__(self, name: str, change) -> None:
        super().__init__()
        self._altered, self._change = name, change

    def vjp(self, saved, cotangent, needs) -> InputGradients:
        gradients = super().vjp(saved, cotangent, needs)
        return gradients._replace(**{self._altered: self._change(getattr(gradients, self._altered))})


def errors(report: GradientCheck, name: str, state: str | None = None) -> list[float]:
    return [r.rel_error for r in report.of(name, state)]


def test_compare_by_hand():
    # ‖(3,4)−(3,0)‖/3 = 4/3 ; cos = 9/(5·3) ; ratio = 5/3
    assert compare(np.array([3.0, 4.0]), np.array([3.0, 0.0]), 1.0) == pytest.approx((4 / 3, 0.6, 5 / 3))


def test_compare_with_a_vanishing_reference():
    assert compare(np.array([0.0]), np.array([0.0]), 2.0) == (0.0, None, None)
    assert compare(np.array([1.0]), np.array([1e-12]), 2.0) == (0.5, None, None)


def test_silent_zero_is_an_error_of_one():
    assert compare(np.zeros(2), np.array([3.0, 0.0]), 1.0) == (1.0, None, 0.0)


@pytest.mark.parametrize("substeps", [1, 16])
def test_fd_jacobian_on_cartpole(cartpole, substeps):
    sim = Simulation(cartpole, 8, substeps, FdJacobian())
    report = check_gradients(sim, states=["standing", "random", "policy"])
    assert report.excluded == 0
    assert report.checked == 24
    for name in ("ctrl", "qpos", "qvel"):
        assert max(errors(report, name, "standing") + errors(report, name, "random")) < 1e-3
        # Fast motion rounds more, and one control may hardly move what its cotangent weighs.
        assert np.median(errors(report, name, "policy")) < 1e-3


@pytest.mark.long
@pytest.mark.parametrize(
    ("cone", "substeps"),
    [("pyramidal", 1), ("elliptic", 4), *slow(("pyramidal", 16), ("elliptic", 1), ("elliptic", 16))],
)
def test_fd_jacobian_on_a_standing_ant(cone, substeps):
    model = mujoco.MjModel.from_xml_string(ant_xml(cone))
    report = check_gradients(Simulation(model, 8, substeps, FdJacobian()), states=["standing"])
    assert report.checked >= 6
    assert report.max_rel_error < 2e-2


@pytest.mark.long
@pytest.mark.parametrize(("substeps", "inputs"), [(1, ("ctrl", "qpos", "qvel")), *slow((16, ("ctrl", "qvel")))])
def test_fd_jacobian_on_an_ant_moving_in_contact(substeps, inputs):
    """The median only: a difference across a touch is wrong by the jump, whatever the perturbation."""
    model = mujoco.MjModel.from_xml_string(ant_xml("elliptic"))
    report = check_gradients(Simulation(model, 16, substeps, FdJacobian()), states=["contact"])
    assert report.checked >= 12
    for name in inputs:
        assert np.median(errors(report, name)) < 2e-2


@pytest.mark.long
@pytest.mark.parametrize("substeps", [4, *slow(1, 16)])
def test_adjoint_on_an_ant_in_contact(substeps):
    """Two derivations that share no code, in all but rounding the same."""
    model = mujoco.MjModel.from_xml_string(ant_xml("elliptic"))
    report = check_gradients(Simulation(model, 12, substeps, tolerance=1e-9), states=["standing", "contact"])
    assert report.checked >= 20
    assert report.max_rel_error < 1e-4
    for name in ("ctrl", "qpos", "qvel"):
        assert np.median(errors(report, name)) < 2e-5


@pytest.mark.parametrize("name", ["ctrl", "qpos", "qvel"])
def test_one_percent_too_long_is_caught(cartpole, name):
    report = check_gradients(Simulation(cartpole, 3, 1, Altered(name, lambda g: 1.01 * g)), states=["random"])
    for r in report.results:
        if r.input == name:
            assert r.rel_error == pytest.approx(0.01, rel=0.05)
            assert r.cosine == pytest.approx(1.0, abs=1e-6)
            assert r.norm_ratio == pytest.approx(1.01, rel=1e-3)
        else:
            assert r.rel_error < 1e-3


def test_wrong_direction_is_caught(cartpole):
    report = check_gradients(Simulation(cartpole, 2, 1, Altered("qvel", lambda g: -g)), states=["random"])
    for r in report.of("qvel"):
        assert r.rel_error == pytest.approx(2.0, rel=1e-3)
        assert r.cosine == pytest.approx(-1.0, abs=1e-6)


def test_nan_never_passes(cartpole):
    nan = lambda g: torch.full_like(g, torch.nan)  # noqa: E731
    report = check_gradients(Simulation(cartpole, 2, 1, Altered("ctrl", nan)), states=["random"])
    assert report.max_rel_error == math.inf
    assert all(r.cosine is None and r.norm_ratio is None for r in report.of("ctrl"))


def test_activations_are_checked():
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><option timestep="0.005"/><worldbody>
          <body><joint name="j" damping=".1"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03"/></body>
        </worldbody><actuator><muscle joint="j" force="1" lengthrange="-2 2" tausmooth=".2"/></actuator></mujoco>""")
    report = check_gradients(Simulation(model, 3, 4, FdJacobian()), states=["standing", "random"])
    assert len(report.of("act")) == report.checked > 0
    assert max(errors(report, "act")) < 1e-2


def _tilted_capsule(cone: str) -> tuple[mujoco.MjModel, Point]:
    """A capsule 10° off the vertical, towards (cos 30°, sin 30°), that slides along a plane, one end 1 mm deep."""
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><option timestep="0.004" cone="{cone}"/><worldbody>
          <geom type="plane" size="5 5 1"/>
          <body><freejoint/><geom type="capsule" size=".05 .2" mass="1"/></body>
        </worldbody></mujoco>""")
    tilt = math.radians(10.0)
    height = 0.2 * math.cos(tilt) + 0.05 - 1e-3
    towards = math.radians(30.0)
    axis = np.array([-math.sin(towards), math.cos(towards), 0.0])
    quat = [math.cos(tilt / 2), *(math.sin(tilt / 2) * axis)]
    state = [[], [0.0, 0.0, height, *quat], [0.3, 0.2, 0.0, 0.0, 0.0, 0.0], []]
    return model, Point(*(np.asarray(v, dtype=np.float32).astype(float) for v in state))


@pytest.mark.parametrize(("cone", "differs"), [("elliptic", False), ("pyramidal", True)])
def test_forward_mismatch(cone, differs):
    """A steep capsule gets another tangent frame in mujoco_warp, which shows through a pyramid but not a cone."""
    model, start = _tilted_capsule(cone)
    sim, oracle = Simulation(model, 1, 1, None, "cpu"), Oracle(model, 1)
    inputs = [torch.tensor(v[None], dtype=torch.float32) for v in (start.ctrl, start.qpos, start.qvel, start.act)]
    actual = Point(start.ctrl, *(v[0].numpy().astype(float) for v in sim.step(*inputs)))
    mismatch = forward_mismatch(oracle, start, oracle.step(start), actual)
    assert (mismatch > Limits().forward_mismatch) == differs


def test_forward_mismatch_is_infinite_for_nan():
    model, start = _tilted_capsule("elliptic")
    oracle = Oracle(model, 1)
    end = oracle.step(start)
    assert forward_mismatch(oracle, start, end, end) == 0.0
    bad = Point(end.ctrl, end.qpos, np.full_like(end.qvel, np.nan), end.act)
    assert forward_mismatch(oracle, start, end, bad) == math.inf


def test_excluded_states_are_counted_by_cause_and_nothing_left_never_passes(cartpole):
    sim = Simulation(cartpole, 3, 1, FdJacobian())
    strict = check_gradients(sim, states=["random"], limits=Limits(forward_mismatch=0.0))
    assert (strict.forward_mismatches, strict.kinks, strict.checked) == (3, 0, 0)
    assert strict.max_rel_error == math.inf
    kinky = check_gradients(sim, states=["random"], limits=Limits(side_disagreement=0.0))
    assert (kinky.forward_mismatches, kinky.kinks, kinky.checked) == (0, 3, 0)


def test_same_seed_same_report(cartpole):
    sims = [Simulation(cartpole, 2, 1, FdJacobian()) for _ in range(2)]
    reports = [check_gradients(sim, states=list(STATE_KINDS), seed=7) for sim in sims]
    assert reports[0].results == reports[1].results


def test_lost_contacts_of_the_perturbed_copies_are_an_error():
    """Every copy of every world needs its room, not only the worlds that are stepped."""
    model = mujoco.MjModel.from_xml_string(ant_xml("elliptic"))
    # Lifted far off the ground, the world itself fits; its copies, moved by 1 m, do not.
    sim = Simulation(model, 1, 1, FdJacobian(eps_qpos=1.0), "cpu", capacity=Capacity(rows=4))
    start = sim.initial_state()
    qpos = start.qpos.clone()
    qpos[:, 2] = 1.2
    ctrl = torch.zeros(1, model.nu, requires_grad=True)
    qpos.requires_grad_()
    loss = sim.step(ctrl, qpos, start.qvel, start.act).qvel.sum()
    with pytest.raises(SimulationError, match="njmax"):
        loss.backward()


def test_bad_requests(cartpole):
    with pytest.raises(ConfigError, match="standing"):
        check_gradients(Simulation(cartpole, 1, 1), states=["flying"])
    with pytest.raises(ConfigError, match="make it with a backward mode"):
        check_gradients(Simulation(cartpole, 1, 1, None))
    with pytest.raises(ConfigError, match="degrees of freedom"):
        check_request(mujoco.MjModel.from_xml_string("<mujoco/>"), ["random"])
