"""Fields of the model as arguments of a step: one value for all worlds or one per world, with their gradients."""

import copy

import mujoco
import numpy as np
import pytest
import torch
from oracle import relative, tighten
from scenes import ant, cartpole, random_weights
from test_adjoint_features import SCENES, random_points

from msk_ray.errors import ConfigError, UnsupportedModelError
from msk_ray.step import Simulation
from msk_ray.step.check import Oracle, Point, check_gradients, make_states
from msk_ray.step.check.pullback import simulated_gradients
from msk_ray.step.forward.parameters import PARAMETERS, names_of

WORLDS = 3


def nominal(model: mujoco.MjModel, name: str) -> torch.Tensor:
    return torch.as_tensor(PARAMETERS[name].value(model), dtype=torch.float32)


def inputs(points) -> list[torch.Tensor]:
    return [
        torch.as_tensor(np.stack([getattr(p, n) for p in points]), dtype=torch.float32)
        for n in ("ctrl", "qpos", "qvel", "act")
    ]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    """An ant whose geoms have frictions of their own: which of two equal ones counts is not differentiable."""
    out = ant("elliptic")
    out.geom_friction *= np.linspace(1.0, 1.3, out.ngeom)[:, None]
    return out


@pytest.mark.long
@pytest.mark.parametrize(("cone", "substeps"), [("pyramidal", 1), ("elliptic", 4)])
def test_all_parameters_of_an_ant_in_contact(model, cone, substeps):
    model = copy.copy(model)
    model.opt.cone = int(getattr(mujoco.mjtCone, f"mjCONE_{cone.upper()}"))
    sim = Simulation(model, WORLDS, substeps, tolerance=1e-12)
    result = check_gradients(sim, states=("contact",), parameters=names_of(model))
    assert result.checked >= 2
    for name in names_of(model):
        errors = [r.rel_error for r in result.of(name)]
        assert len(errors) >= result.checked - 1, name
        assert np.median(errors) < (2e-5 if substeps == 1 else 1e-4), name
        assert max(errors) < 1e-3, name


_FEATURES = {
    "springs": ("springs", ["jnt_stiffness", "qpos_spring", "dof_damping"]),
    "ball_spring": ("ball_spring", ["jnt_stiffness", "qpos_spring", "body_iquat"]),
    "gravcomp": ("gravcomp", ["body_mass", "body_ipos", "opt.gravity"]),
    "servos": ("position", ["actuator_gear", "actuator_gainprm", "actuator_biasprm"]),
    "limits": ("limits", ["jnt_range", "jnt_solref", "jnt_solimp"]),
    "ball_limit": ("ball_limit", ["jnt_range", "jnt_solref"]),
    "friction_loss": ("friction_loss", ["dof_frictionloss", "dof_solref", "dof_solimp"]),
    "tendon_spring": ("site_tendon", ["tendon_stiffness", "tendon_lengthspring", "tendon_damping", "site_pos"]),
    "tendon_limit": ("site_tendon_limit", ["tendon_range", "tendon_solref_lim", "tendon_solimp_lim", "site_pos"]),
    "tendon_friction": ("site_tendon_friction", ["tendon_frictionloss", "tendon_solref_fri", "tendon_solimp_fri"]),
    "pulley": ("pulley", ["site_pos", "actuator_gear"]),
    "inside_sphere": ("sphere_wrap_inside", ["site_pos", "geom_pos", "geom_size"]),
    "inside_cylinder": ("cylinder_wrap_inside", ["site_pos", "geom_pos", "geom_size"]),
    "equality": ("equality_joint", ["opt.timestep"]),
    "weld": ("weld_bodies", ["opt.timestep"]),
    "implicit_servo": ("fast_fixed_tendon", ["opt.timestep", "tendon_damping", "actuator_gear", "actuator_biasprm"]),
    "site": ("site", ["actuator_gear"]),
    "ball_servo": ("ball_in_parent", ["actuator_gear", "actuator_biasprm"]),
    "slider_crank": ("slider_crank", ["actuator_gainprm", "actuator_biasprm"]),
    "implicit_ball_servo": ("fast_refsite", ["actuator_biasprm"]),
    "rk4_muscle": ("rk4_muscle", ["actuator_gainprm", "actuator_dynprm", "dof_damping", "body_mass"]),
    "muscle": ("muscle", ["actuator_gainprm", "actuator_biasprm", "actuator_dynprm", "actuator_gear"]),
    "tendon_servo": ("fast_site_tendon", ["actuator_gear", "actuator_gainprm", "actuator_biasprm", "dof_damping"]),
}


@pytest.mark.parametrize("name", _FEATURES)
def test_parameters_of_a_feature(name):
    scene, names = _FEATURES[name]
    model = SCENES[scene]()
    result = check_gradients(Simulation(model, 4, 2, tolerance=1e-12), states=("random",), parameters=names)
    assert result.checked >= 3
    for parameter in names:
        errors = [r.rel_error for r in result.of(parameter)]
        assert errors, parameter
        assert max(errors) < 1e-4, parameter


def test_damping_of_a_tendon_on_a_free_body_is_explicit_as_in_the_step():
    """C MuJoCo takes it implicitly, so the oracle is the step's own difference, which is linear in the damping."""
    model = SCENES["fast_spinning_free"]()
    sim, points = Simulation(model, 4, 1, tolerance=1e-12), random_points(model, 4, seed=5)
    weights = torch.as_tensor(random_weights(model, 4, seed=2)["qvel"], dtype=torch.float32)

    def score(damping: torch.Tensor) -> torch.Tensor:
        return (sim.step(*inputs(points), parameters={"tendon_damping": damping}).qvel * weights).sum(1)

    damping = torch.ones((4, 1), requires_grad=True)
    (slope,) = torch.autograd.grad(score(damping).sum(), damping)
    expected = (score(damping.detach() + 0.5) - score(damping.detach() - 0.5)).numpy()
    assert relative(slope.numpy().ravel(), expected) < 1e-3


_SOLIDS = """<mujoco><option timestep=".004"/><default><geom solref=".03 1" contype="0"/></default><worldbody>
<geom type="plane" size="3 3 1" euler="3 2 0" contype="1"/>
<geom name="below" type="box" pos="2 0 .1" size=".2 .3 .1" euler="5 3 0" contype="2"/>
<geom name="log" type="cylinder" pos="3 0 .1" size=".1 .3" euler="90 3 0" contype="2"/>
<body pos="0 0 .15" euler="20 30 10"><freejoint/><geom type="cylinder" size=".1 .12" pos=".01 0 0"/></body>
<body pos="1 0 .12" euler="10 7 10"><freejoint/><geom type="box" size=".1 .12 .08" pos=".01 0 0"/></body>
<body pos="0 1 .1" euler="30 20 10"><freejoint/><geom type="ellipsoid" size=".1 .12 .09" pos=".01 0 0"/></body>
<body pos="1 1 .2" euler="70 20 10"><freejoint/><geom type="capsule" size=".06 .12" pos=".01 0 0"/></body>
<body pos="2 0 .29" euler="30 20 10"><freejoint/><geom size=".1" pos=".01 0 0" conaffinity="3"/></body>
<body pos="3 0 .28" euler="30 20 10"><freejoint/><geom size=".1" pos=".01 0 0" conaffinity="3"/></body>
</worldbody></mujoco>"""


def test_pose_and_size_of_every_shape():
    model = tighten(mujoco.MjModel.from_xml_string(_SOLIDS))
    names = ["geom_pos", "geom_quat", "geom_size"]
    result = check_gradients(Simulation(model, 3, 1, tolerance=1e-12), states=("standing",), parameters=names)
    assert result.checked >= 2
    for parameter in names:
        assert len(result.of(parameter)) >= 2, parameter
        assert max(r.rel_error for r in result.of(parameter)) < 1e-3, parameter


def test_geoms_that_paths_wrap_around():
    model, names = SCENES["muscle"](), ["site_pos", "geom_pos", "geom_size"]
    points = [Point(p.ctrl, p.qpos, p.qvel, p.act) for p in random_points(model, 6, seed=5)]
    cotangents = random_weights(model, len(points), seed=2)
    rows = np.concatenate([cotangents[n] for n in ("qpos", "qvel", "act")], axis=1).astype(np.float32).astype(float)
    _, found = simulated_gradients(Simulation(model, len(points), 2, tolerance=1e-12), points, rows, names)
    oracle, touching = Oracle(model, 2, names), 0
    for world, point in enumerate(points):
        for name, reference in oracle.linearize(point).pull_back(rows[world]).items():
            if name in names:
                assert relative(found[name][world], reference) < 1e-5, (world, name)
                touching += bool(name == "geom_size" and np.any(reference))
    assert touching >= 2


def test_a_larger_geom_meets_others_where_the_model_s_own_would_not():
    """Bounds of the broad phase follow the size."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="sphere" size=".1"/>
        <body pos="0 0 1"><freejoint/><geom type="sphere" size=".1"/></body></worldbody></mujoco>"""
    )
    sizes = nominal(model, "geom_size").expand(2, -1, -1).clone()
    sizes[1, 1, 0] = 1.0
    sim = Simulation(model, 2, 1)
    end = sim.step(torch.zeros(2, 0), *sim.initial_state(), parameters={"geom_size": sizes})
    assert end.qvel[0, 2] == pytest.approx(-9.81 * model.opt.timestep, rel=1e-3)
    assert end.qvel[1, 2] > 0.0


def test_a_spring_and_friction_that_the_model_lacks_can_be_given():
    """Steps equal those of C MuJoCo with the same values."""
    model = SCENES["site_tendon_friction"]()
    model.tendon_frictionloss[:] = 0.0
    names = ["jnt_stiffness", "dof_frictionloss", "tendon_frictionloss", "tendon_stiffness", "tendon_damping"]
    values = {n: 0.5 + torch.rand(nominal(model, n).shape, generator=torch.Generator().manual_seed(0)) for n in names}
    points = make_states(model, "random", WORLDS, 2)
    end = Simulation(model, WORLDS, 2, tolerance=1e-12).step(*inputs(points), parameters=values)
    edited = copy.copy(model)
    for name, value in values.items():
        PARAMETERS[name].value(edited)[...] = value.numpy()
    for world, point in enumerate(points):
        assert relative(end.qvel[world].numpy(), Oracle(edited, 2).step(point).qvel) < 1e-4


def test_an_element_at_a_kink_of_its_own_is_left_out_and_counted():
    """Two equal frictions: which one counts is not differentiable, and the others' gradients are compared still."""
    model = ant("elliptic")
    sim = Simulation(model, 2, 1, tolerance=1e-12)
    result = check_gradients(sim, states=("contact",), parameters=["geom_friction", "body_mass"])
    assert result.checked == 2
    assert result.parameter_kinks > 0
    assert len(result.of("body_mass")) == 2
    assert result.max_rel_error < 1e-3


def test_the_page_names_every_parameter(root):
    page = (root / "docs" / "step" / "parameters.md").read_text()
    table = [line for line in page.splitlines() if line.startswith("| `")]
    named = {name.strip(" `") for line in table for name in line.split("|")[1].split(",")}
    assert named == set(PARAMETERS)


def test_each_world_has_its_own_values_and_gradients(model):
    rng = np.random.default_rng(3)
    names = ["body_mass", "geom_friction", "actuator_gear", "opt.gravity"]
    points = make_states(model, "contact", WORLDS, 1)
    factors = {n: 1.0 + 0.2 * rng.random((WORLDS, *nominal(model, n).shape)) for n in names}
    values = {n: (nominal(model, n) * torch.as_tensor(f, dtype=torch.float32)) for n, f in factors.items()}
    for value in values.values():
        value.requires_grad_()
    sim = Simulation(model, WORLDS, 2, tolerance=1e-12)
    weights = rng.standard_normal((WORLDS, model.nv)).astype(np.float32)
    end = sim.step(*inputs(points), parameters=values)
    (end.qvel * torch.as_tensor(weights)).sum().backward()
    for world, point in enumerate(points):
        edited = copy.copy(model)
        for name in names:
            row = values[name][world].detach().numpy().astype(float)
            PARAMETERS[name].value(edited)[...] = row
        oracle = Oracle(edited, 2, names)
        line = oracle.linearize(point)
        assert relative(end.qvel[world].detach().numpy(), line.end.qvel) < 1e-4
        cotangent = np.concatenate((np.zeros(model.nv), weights[world], np.zeros(model.na)))
        for name in names:
            smooth = ~line.bent[name]
            found = values[name].grad[world].numpy().ravel()[smooth]
            assert relative(found, line.pull_back(cotangent)[name][smooth]) < 1e-4, (world, name)
    # The values of a step do not stay: the next one without them has the model's own.
    plain = Simulation(model, WORLDS, 2, tolerance=1e-12).step(*inputs(points))
    assert torch.equal(sim.step(*inputs(points)).qvel, plain.qvel)


@pytest.mark.parametrize("name", ["body_mass", "opt.timestep", "geom_size"])
def test_one_value_for_all_worlds_gets_the_sum(model, name):
    points = make_states(model, "contact", WORLDS, 1)
    own = nominal(model, name)
    grads = []
    for rows in ((), (WORLDS,)):
        value = own.expand((*rows, *own.shape)).clone().requires_grad_()
        sim = Simulation(model, WORLDS, 2)
        first = sim.step(*inputs(points), parameters={name: value})
        # A second step at other values, whose gradient is taken first, must not disturb the first.
        second = sim.step(inputs(points)[0], *first, parameters={name: 1.1 * value})
        second.qvel.sum().backward()
        grads.append(value.grad)
    assert grads[0].shape == own.shape
    torch.testing.assert_close(grads[1].sum(0), grads[0], rtol=1e-4, atol=1e-5 * float(grads[0].abs().max()))


def test_steps_that_share_values_give_the_sum_of_their_gradients(model):
    """They share one tensor on the way into autograd: a second rollout, and values changed in place, included."""
    points = make_states(model, "contact", WORLDS, 0)
    values = {
        "body_mass": nominal(model, "body_mass").requires_grad_(),
        "geom_friction": nominal(model, "geom_friction").repeat(WORLDS, 1, 1).requires_grad_(),
        "dof_damping": nominal(model, "dof_damping"),
    }
    leaves = [values["body_mass"], values["geom_friction"]]
    sim = Simulation(model, WORLDS, 1)

    def rollout(given):
        ctrl, *state = inputs(points)
        seen = []
        for parameters in given:
            state = sim.step(ctrl, *state, parameters=parameters)
            seen.append(state.qvel)
        return torch.autograd.grad(torch.stack(seen).square().sum(), leaves)

    # Views of the same leaves, made anew for each step, cannot share anything.
    apart = rollout([{**values, "body_mass": leaves[0] * 1.0, "geom_friction": leaves[1] * 1.0} for _ in range(3)])
    for found in (rollout([values] * 3), rollout([values] * 3)):
        for a, b in zip(found, apart, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6 * float(b.abs().max()))
    with torch.no_grad():
        leaves[0] *= 1.5
    heavier = rollout([values] * 3)[0]
    assert (heavier - apart[0]).norm() > 1e-2 * apart[0].norm()
    expected = rollout([{**values, "body_mass": leaves[0] * 1.0} for _ in range(3)])[0]
    torch.testing.assert_close(heavier, expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max()))


def test_both_tapes_agree(model):
    points = make_states(model, "contact", WORLDS, 1)
    cotangents = np.random.default_rng(0).standard_normal((WORLDS, 2 * model.nv))
    names = names_of(model)
    found = []
    for mode in ("tape_per_substep", "tape_all"):
        sim = Simulation(model, WORLDS, 2, mode)
        found.append(simulated_gradients(sim, points, cotangents, names)[1])
    for name in names:
        assert relative(found[0][name], found[1][name]) < 1e-5, name


def test_a_world_that_diverged_gets_exactly_zero_if_nothing_flows_back(model):
    ctrl, qpos, qvel, act = inputs(make_states(model, "contact", WORLDS, 1))
    qvel[0] = torch.nan
    mass = nominal(model, "body_mass").expand(WORLDS, -1).clone().requires_grad_()
    end = Simulation(model, WORLDS, 2).step(ctrl, qpos, qvel, act, parameters={"body_mass": mass})
    end.qvel[1:].sum().backward()
    assert torch.all(mass.grad[0] == 0.0)
    assert torch.all(mass.grad[1:, 1] != 0.0)


def test_a_step_without_parameters_launches_what_it_did_before(model):
    """Parameters that need no gradient, such as random ones in training, add nothing to the pullback."""
    sim = Simulation(model, WORLDS, 2)
    ctrl, *state = inputs(make_states(model, "contact", WORLDS, 1))
    ctrl.requires_grad_()
    friction = nominal(model, "geom_friction")
    for parameters in (None, {"geom_friction": friction}):
        sim.step(ctrl, *state, parameters=parameters).qvel.sum().backward()
    assert list(sim.backward._parameters) == []


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"body_mas": torch.ones(3)}, "did you mean body_mass"),
        ({"light": torch.ones(3)}, "write one of body_mass"),
        ({"pair_friction": torch.ones(0, 5)}, "the model has no pair_friction"),
        ({"body_mass": torch.ones(4)}, r"shape \(4,\), but this model takes \(3,\)"),
        ({"body_mass": torch.ones(3).double()}, "float64"),
    ],
)
def test_wrong_values_are_refused(values, message):
    sim = Simulation(cartpole(), 2, 1)
    with pytest.raises(ConfigError, match=message):
        sim.step(torch.zeros(2, 1), *sim.initial_state(), parameters=values)


def test_a_mode_without_gradients_of_parameters_says_so():
    sim = Simulation(cartpole(), 2, 1, "fd_jacobian")
    mass = torch.ones(3, requires_grad=True)
    with pytest.raises(UnsupportedModelError, match=r"fd_jacobian has no gradients of parameters \(body_mass\)"):
        sim.step(torch.zeros(2, 1), *sim.initial_state(), parameters={"body_mass": mass})


def test_finite_differences_follow_the_values_of_each_world():
    start = Simulation(cartpole(), 2, 1).initial_state()
    gears = torch.zeros(2, 1, 6)
    gears[:, 0, 0] = torch.tensor([50.0, 150.0])
    ctrl = torch.full((2, 1), 0.1, requires_grad=True)
    sim = Simulation(cartpole(), 2, 1, "fd_jacobian")
    sim.step(ctrl, *start, parameters={"actuator_gear": gears}).qvel.sum().backward()
    assert ctrl.grad[1] / ctrl.grad[0] == pytest.approx(3.0, rel=1e-3)


def test_a_centre_of_mass_that_the_inertia_matrix_cannot_follow_is_refused():
    lone = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="ball"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    )
    sim = Simulation(lone, 1, 1)
    with pytest.raises(UnsupportedModelError, match=r"body_ipos is not supported: the inertia of body ball"):
        sim.open_parameters(["body_ipos"])
    assert "body_ipos" not in names_of(lone)
    wet = copy.copy(lone)
    wet.opt.density = 1.2
    spinning = SCENES["fast_spinning_free"]()
    with pytest.raises(UnsupportedModelError, match="body_inertia is not supported: implicitfast takes gyroscopic"):
        Simulation(spinning, 1, 1).open_parameters(["body_inertia"])
    with pytest.raises(UnsupportedModelError, match="tendon_damping is not supported: implicitfast drops slopes"):
        Simulation(SCENES["fast_branching_spring"](), 1, 1).open_parameters(["tendon_damping"])
    with pytest.raises(UnsupportedModelError, match="actuator_gear is not supported: the gear of an actuator between"):
        Simulation(SCENES["refsite"](), 1, 1).open_parameters(["actuator_gear"])
    with pytest.raises(UnsupportedModelError, match="body_mass is not supported: the drag of a fluid"):
        Simulation(wet, 1, 1).open_parameters(["body_mass"])
    result = check_gradients(sim, states=("random",), parameters=["body_mass", "body_inertia"])
    assert result.max_rel_error < 1e-3


def test_forces_from_outside_act_at_the_centre_of_mass_that_is_given(model):
    """`body_ipos` moves the point at which `xfrc_applied` acts; against differences of the step itself."""
    points = make_states(model, "contact", WORLDS, 1)
    push = torch.as_tensor(np.random.default_rng(4).normal(size=(WORLDS, model.nbody, 6)), dtype=torch.float32)
    push[:, 0] = 0.0
    sim = Simulation(model, WORLDS, 1, tolerance=1e-12)
    ipos = nominal(model, "body_ipos").requires_grad_()
    qvel = {}
    for scale in (0.0, 20.0):
        end = sim.step(*inputs(points), xfrc_applied=scale * push, parameters={"body_ipos": ipos})
        (gradient,) = torch.autograd.grad(end.qvel[:, :6].sum(), ipos)
        qvel[scale] = gradient
        moved = ipos.detach().clone()
        change = []
        for sign in (1.0, -1.0):
            moved[3, 1] = ipos[3, 1].detach() + sign * 1e-2
            end = sim.step(*inputs(points), xfrc_applied=scale * push, parameters={"body_ipos": moved})
            change.append(end.qvel[:, :6].sum().item())
        assert (change[0] - change[1]) / 2e-2 == pytest.approx(gradient[3, 1].item(), rel=2e-2)
    assert abs(qvel[20.0][3, 1] - qvel[0.0][3, 1]) > 0.1 * abs(qvel[0.0][3, 1])


def test_jacobians_are_those_at_the_values_given(model):
    """`linearize` runs rows as further worlds, each with the values of its own world."""
    points = make_states(model, "contact", WORLDS, 1)
    values = {"body_mass": nominal(model, "body_mass") * torch.tensor([[0.8], [1.0], [1.3]])}
    sim = Simulation(model, WORLDS, 2)
    found = sim.linearize(*inputs(points), parameters=values)
    for world in range(WORLDS):
        alone = Simulation(model, 1, 2).linearize(
            *(value[world : world + 1] for value in inputs(points)),
            parameters={"body_mass": values["body_mass"][world]},
        )
        torch.testing.assert_close(found.A[world], alone.A[0], rtol=1e-3, atol=1e-3)


def test_friction_of_a_pair_that_follows_its_normal_is_no_parameter():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom name="a" type="plane" size="1 1 1"/>
        <body><freejoint/><geom name="b" size=".1"/></body></worldbody>
        <contact><pair name="p" geom1="a" geom2="b"/></contact></mujoco>"""
    )
    with pytest.raises(UnsupportedModelError, match="pair p has none of its own and follows solref"):
        Simulation(model, 1, 1).open_parameters(["pair_solreffriction"])


def test_pairs_that_are_parameters_are_not_set_behind_the_back_of_a_step():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom name="a" type="plane" size="1 1 1"/>
        <body><freejoint/><geom name="b" size=".1"/></body></worldbody>
        <contact><pair geom1="a" geom2="b"/></contact></mujoco>"""
    )
    sim = Simulation(model, 1, 1)
    sim.open_parameters(["pair_friction"])
    sim.batch.set_contact_pairs({"solref": np.array([[0.05, 1.0]])})
    with pytest.raises(ConfigError, match="pair_friction is a parameter of this simulation's steps"):
        sim.batch.set_contact_pairs({"friction": np.ones((1, 5))})
