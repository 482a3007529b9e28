"""Parameters drawn per world and episode: their values, their gradients, where they apply, and exact resumption."""

import copy
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from oracle import INPUTS, differences, relative
from scenes import ant, ant_points, random_weights

from msk_ray.config import Config, PhysicsConfig, RandomizeConfig, overlay, parse_config
from msk_ray.envs import make_env
from msk_ray.envs.randomize import Randomizer
from msk_ray.errors import ConfigError
from msk_ray.experiment.metrics import read_metrics
from msk_ray.step import Simulation
from msk_ray.training import Trainer
from msk_ray.training.evaluation import Evaluator

pytestmark = pytest.mark.long

EVERYTHING: dict[str, Any] = {
    "geom_friction": {"low": 0.4, "high": 1.2, "mode": "value"},
    "body_mass": {"low": 0.7, "high": 1.4, "each": True},
    "dof_damping": {"low": 0.5, "high": 2.0, "distribution": "log_uniform"},
    "dof_armature": {"low": 0.02, "high": 0.1, "mode": "value", "only": ["hip0", "knee1"]},
    "dof_frictionloss": {"low": 0.1, "high": 0.5, "mode": "value", "only": ["knee0"]},
    "actuator_gear": {"low": 0.8, "high": 1.2, "each": True},
    "gravity": {"low": 0.9, "high": 1.1},
}


def drawn(model: mujoco.MjModel, nworld: int = 4, seed: int = 0, **fields: dict[str, Any]) -> dict[str, torch.Tensor]:
    made = randomizer(model, seed, **fields)
    return made.values(made.draw(nworld))


def randomizer(model: mujoco.MjModel, seed: int = 0, **fields: dict[str, Any]) -> Randomizer:
    return Randomizer(RandomizeConfig.model_validate(fields), model, torch.device("cpu"), seed)


def test_values_are_drawn_where_the_section_says() -> None:
    model = ant()
    found = drawn(model, 2000, **EVERYTHING)
    friction = found["geom_friction"]
    assert (friction[..., 0] == friction[:, :1, 0]).all(), "one number for all geoms of a world"
    assert (friction[..., 1:] == torch.tensor(model.geom_friction[:, 1:], dtype=torch.float32)).all()
    assert friction[..., 0].min() >= 0.4
    assert friction[..., 0].max() <= 1.2
    assert abs(float(friction[:, 0, 0].mean()) - 0.8) < 0.02
    mass = found["body_mass"][:, 1:] / torch.tensor(model.body_mass[1:], dtype=torch.float32)
    assert mass.std(0).min() > 0.15, "a number of its own for every body"
    assert abs(float(torch.corrcoef(mass[:, :2].T)[0, 1])) < 0.1
    inertia = found["body_inertia"][:, 1:, 2] / torch.tensor(model.body_inertia[1:, 2], dtype=torch.float32)
    torch.testing.assert_close(inertia, mass)
    damping = found["dof_damping"][:, -1] / float(model.dof_damping[-1])
    assert abs(float(damping.log().mean())) < 0.03, "twice as much is as likely as half as much"
    changed = (found["dof_armature"] != torch.tensor(model.dof_armature, dtype=torch.float32)).any(0)
    assert [model.joint(int(model.dof_jntid[dof])).name for dof in np.flatnonzero(changed)] == ["hip0", "knee1"]
    assert (found["opt.gravity"][:, :2] == 0.0).all()
    assert found["opt.gravity"][:, 2].max() < -8.8


def test_numbers_are_not_those_that_initial_states_are_drawn_from() -> None:
    """Fails where both generators have one seed: a policy that sees where it starts would know its friction."""
    made = randomizer(ant(), seed=3, geom_friction={"low": 1e-9, "high": 1.0})
    states = torch.rand((500, 1), generator=torch.Generator().manual_seed(3))
    both = torch.cat((made.draw(500), states), dim=1).T
    assert abs(float(torch.corrcoef(both)[0, 1])) < 0.2


def test_a_muscle_is_stronger_by_its_force_not_by_its_range() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="j" range="-57 57"/><geom size=".1"/></body></worldbody><actuator>
        <muscle joint="j" force="30"/><position joint="j" kp="5" kv="1"/></actuator></mujoco>"""
    )
    found = drawn(model, 1, actuator_gain={"low": 2.0, "high": 2.0})
    gain = torch.tensor(model.actuator_gainprm, dtype=torch.float32)
    bias = torch.tensor(model.actuator_biasprm, dtype=torch.float32)
    assert found["actuator_gainprm"][0, 0].tolist()[:5] == [*gain[0, :2], 60.0, 2.0 * gain[0, 3], gain[0, 4]]
    assert found["actuator_gainprm"][0, 1, 0] == 10.0
    assert found["actuator_biasprm"][0, 1].tolist()[:3] == (2.0 * bias[1, :3]).tolist()


SERVOS = """<mujoco><worldbody><body name="arm"><joint name="j"/><geom size=".1"/></body></worldbody><actuator>
  <position joint="j" kp="5" kv="1"/><motor joint="j"/><position joint="j" kp="20" kv="3"/></actuator></mujoco>"""


def test_stiffness_and_damping_of_servos_are_drawn_apart() -> None:
    model = mujoco.MjModel.from_xml_string(SERVOS)
    found = drawn(model, 1, actuator_kp={"low": 2.0, "high": 2.0}, actuator_kd={"low": 0.5, "high": 0.5})
    assert found["actuator_gainprm"][0, :, 0].tolist() == [10.0, 1.0, 40.0]
    assert found["actuator_biasprm"][0, :, :3].tolist() == [[0.0, -10.0, -0.5], [0.0] * 3, [0.0, -40.0, -1.5]]
    with pytest.raises(ConfigError, match="actuator_gain includes actuator_kp; leave one of both out"):
        drawn(model, 1, actuator_kp={"low": 2.0, "high": 2.0}, actuator_gain={"low": 0.5, "high": 0.5})
    with pytest.raises(ConfigError, match="actuator_kp: the model has no actuator whose value could be drawn"):
        drawn(ant(), 1, actuator_kp={"low": 2.0, "high": 2.0})


def test_mass_centres_and_gravity_are_added_to_those_of_the_model() -> None:
    model = ant()
    torso = [model.body(1).name]
    found = drawn(
        model,
        2000,
        body_mass={"low": 2.0, "high": 2.0},
        payload={"low": 0.0, "high": 1.0, "only": torso},
        body_ipos={"size": [0.01, 0.02, 0.0], "only": torso},
        gravity_shift={"size": [0.5, 0.5, 0.3]},
        gravity={"low": 0.5, "high": 0.5},
    )
    mass, own = found["body_mass"], torch.tensor(model.body_mass, dtype=torch.float32)
    assert torch.equal(mass[:, 2:], 2.0 * own[2:].expand(2000, -1))
    load = mass[:, 1] - 2.0 * own[1]
    assert (round(float(load.min()), 2), round(float(load.max()), 2)) == (0.0, 1.0)
    inertia = torch.tensor(model.body_inertia, dtype=torch.float32)
    assert torch.equal(found["body_inertia"], 2.0 * inertia.expand(2000, -1, -1))
    centre = found["body_ipos"] - torch.tensor(model.body_ipos, dtype=torch.float32)
    assert not centre[:, 2:].any()
    assert centre[:, 1].abs().amax(0).tolist() == pytest.approx([0.01, 0.02, 0.0], rel=0.02)
    assert abs(float(torch.corrcoef(centre[:, 1, :2].T)[0, 1])) < 0.1
    gravity = found["opt.gravity"] - torch.tensor([0.0, 0.0, 0.5 * float(model.opt.gravity[2])])
    assert gravity.abs().amax(0).tolist() == pytest.approx([0.5, 0.5, 0.3], rel=0.02)
    every = drawn(model, 4, body_ipos={"size": [0.01] * 3, "each": True})["body_ipos"]
    shift = (every - torch.tensor(model.body_ipos, dtype=torch.float32))[0, 1:]
    assert len(shift.unique()) == shift.numel()


def test_every_world_has_the_gradient_of_its_own_model() -> None:
    model = ant("elliptic")
    points = ant_points(model, 4, seed=2)
    own = drawn(model, **EVERYTHING)
    weights = random_weights(model, 4, 3)
    sim = Simulation(model, 4, 4, tolerance=1e-12)
    stacked = {n: np.stack([getattr(p, n) for p in points]) for n in INPUTS}
    inputs = [torch.tensor(value, dtype=torch.float32, requires_grad=True) for value in stacked.values()]
    end = sim.step(*inputs, parameters=own)
    cotangent = {n: torch.tensor(w, dtype=torch.float32) for n, w in weights.items()}
    loss = (end.qvel * cotangent["qvel"]).sum()
    loss = loss + (end.qpos * sim.tangent.lift(end.qpos.detach(), cotangent["qpos"])).sum()
    sim.step(*(value.detach() for value in inputs))  # under the model's own values, in between
    found = dict(zip(INPUTS, torch.autograd.grad(loss, inputs, allow_unused=True), strict=True))
    found["qpos"] = sim.tangent.project(inputs[1].detach(), found["qpos"])
    checked = 0
    for i, point in enumerate(points):
        mine = copy.copy(model)
        for name, values in own.items():
            holder, field = (mine.opt, name[4:]) if name.startswith("opt.") else (mine, name)
            getattr(holder, field)[:] = values[i].double().numpy()
        expected, kink = differences(mine, point, 4, {n: w[i] for n, w in weights.items()})
        if kink > 1e-2:
            continue
        checked += 1
        for name in ("ctrl", "qpos", "qvel"):
            assert relative(found[name][i].numpy(), expected[name]) < 1e-3, (i, name)
    assert checked >= 3


@pytest.fixture
def config(tiny_settings: dict[str, Any]) -> Config:
    """A CartPole trial of seconds with other masses and another motor in each episode of four steps."""
    drawn = {"body_mass": {"low": 0.5, "high": 2.0, "distribution": "log_uniform", "each": True}}
    drawn["actuator_gear"] = {"low": 0.8, "high": 1.2}
    return parse_config(overlay(tiny_settings, {"physics.randomize": drawn, "env.episode_length": 4}))


def test_an_episode_keeps_its_numbers_and_the_next_has_others(config: Config) -> None:
    env = make_env(config.env, config.physics, 6, "cpu", 0, randomize=True)
    assert env.randomizer is not None
    env.state = env.state._replace(age=torch.tensor([0, 0, 0, 2, 2, 2]))
    seen = []
    for _ in range(3):
        seen.append(env.parameters["body_mass"])
        env.step(torch.zeros(6, 1))
    assert torch.equal(seen[0], seen[1])
    assert torch.equal(seen[1][:3], seen[2][:3])
    assert (seen[1][3:, 1:] != seen[2][3:, 1:]).all()
    shown = env.randomizer.metrics(env.state.numbers)
    assert shown["randomize/body_mass_min"] >= 0.5
    assert shown["randomize/body_mass_max"] <= 2.0


def test_a_step_is_pulled_back_under_the_numbers_it_was_made_with(config: Config) -> None:
    """The episode ends after the step, so that others are in the model when the gradient is asked for."""
    gradients = []
    for later in (0, 2):
        env = make_env(config.env, config.physics, 6, "cpu", 0, randomize=True)
        env.state = env.state._replace(age=torch.full((6,), 3))
        action = torch.full((6, 1), 0.3, requires_grad=True)
        reward = env.step(action).reward
        for _ in range(later):
            env.step(torch.zeros(6, 1))
        gradients.append(torch.autograd.grad(reward.sum(), action)[0])
    assert torch.equal(*gradients)
    assert len(set(gradients[0].flatten().tolist())) == 6


def test_evaluation_is_under_the_models_own_parameters(config: Config) -> None:
    plain = config.model_copy(update={"physics": PhysicsConfig()})
    policy = lambda obs: obs[:, :1].tanh()  # noqa: E731
    scores = [Evaluator(c, "cpu").episodes(policy).score for c in (config, plain)]
    assert torch.equal(*scores)
    assert make_env(config.env, config.physics, 2, "cpu", 0).randomizer is None


@pytest.mark.parametrize("algorithm", ["shac", "ppo"])
def test_a_resumed_trial_draws_the_same_numbers(config: Config, tmp_path: Path, algorithm: str) -> None:
    settings = config.as_dict()
    if algorithm == "ppo":
        del settings["shac"]
        settings |= {"algorithm": {"name": "ppo"}, "ppo": {"steps": 8}}
    trial = parse_config(settings)
    rows = []
    for name, stops in (("whole", []), ("cut", [5])):
        for stop in (*stops, None):
            trainer = Trainer(trial, tmp_path / name, "cpu")
            if stop is None and stops:
                trainer.restore_latest()
            while not trainer.finished and trainer.epoch != stop:
                trainer.run_epoch()
            trainer.close()
        rows.append(read_metrics(tmp_path / name / "metrics.jsonl"))
    timed = ("seconds", "env_steps_per_s")
    whole, cut = ([{k: v for k, v in r.items() if k not in timed and "time/" not in k} for r in part] for part in rows)
    assert whole == cut
    assert {"randomize/actuator_gear_min", "randomize/actuator_gear_max"} <= set(whole[-1])


def test_an_environment_from_outside_is_randomized_too() -> None:
    physics = PhysicsConfig.model_validate(
        {"randomize": {"geom_friction": {"low": 0.4, "high": 1.2, "mode": "value", "only": ["foot", "floor"]}}}
    )
    settings = parse_config({"env": {"name": "hopper:Hopper"}}).env
    env = make_env(settings, physics, 3, "cpu", 0, randomize=True)
    action = torch.zeros(3, env.action_size, requires_grad=True)
    for _ in range(3):
        transition = env.step(action)
    transition.reward.sum().backward()
    assert action.grad is not None
    assert env.randomizer is not None
    friction = env.parameters["geom_friction"][:, :, 0]
    names = [env.model.geom(i).name for i in range(env.model.ngeom)]
    assert len(set(friction[:, names.index("foot")].tolist())) == 3
    assert len(set(friction[:, 1].tolist())) == 1


REFUSED = {
    "geom_frction": ({"low": 1.0, "high": 2.0}, "geom_friction"),
    "geom_friction": ({"low": 2.0, "high": 1.0}, r"low 2 is above high 1; exchange them"),
    "body_mass": ({"low": 1.0, "high": 2.0, "mode": "value"}, "scale"),
    "gravity": ({"low": 0.0, "high": 2.0}, "greater than 0"),
    "payload": ({"low": 0.0, "high": 2.0}, "only"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_makes_no_sense_is_refused(name: str, tiny_settings: dict[str, Any]) -> None:
    section, why = REFUSED[name]
    with pytest.raises(ConfigError, match=why):
        parse_config(overlay(tiny_settings, {"physics.randomize": {name: section}}))


def test_what_the_model_does_not_have_is_refused() -> None:
    section = {"low": 0.5, "high": 1.5}
    with pytest.raises(ConfigError, match=r"geom_friction.only: the model has no geom 'foot'; it has floor"):
        randomizer(ant(), geom_friction=section | {"only": ["foot"]})
    with pytest.raises(ConfigError, match=r"jnt_stiffness: it is 0 in the model.*write mode: value"):
        randomizer(ant(), jnt_stiffness=section)
    with pytest.raises(ConfigError, match="pair_friction: the model has no pair"):
        randomizer(ant(), pair_friction=section)
    with pytest.raises(ConfigError, match=r"gravity: .*leave out only and each"):
        randomizer(ant(), gravity=section | {"each": True})
    assert drawn(ant(), geom_friction=section)["geom_friction"].isfinite().all()


FLOOR, BALL = "floor", "ball"
SLIDING: dict[str, tuple[dict[str, str], dict[str, Any], str | None]] = {
    "the same priority": ({}, {"only": [BALL], "low": 1.1, "high": 2.0}, None),
    "the larger of both": (
        {},
        {"only": [BALL], "low": 0.5, "high": 1.0},
        "'floor', at least 1, over that of 'ball', at",
    ),
    "both": ({}, {"low": 0.5, "high": 0.9}, None),
    "one of them first": ({BALL: 'priority="1"'}, {"only": [BALL], "low": 0.5, "high": 0.9}, None),
    "the other one first": (
        {BALL: 'priority="1"'},
        {"only": [FLOOR], "low": 2.0, "high": 4.0},
        "'ball' has priority ov",
    ),
    "both, one of them first": ({BALL: 'priority="1"'}, {"low": 2.0, "high": 4.0}, None),
    "each of two, one of them first": (
        {BALL: 'priority="1"'},
        {"only": [FLOOR, BALL], "each": True, "low": 2.0, "high": 4.0},
        "'ball' has priority over 'floor', so that its own friction counts; draw that",
    ),
    "each of all": ({BALL: 'priority="1"'}, {"each": True, "low": 2.0, "high": 4.0}, None),
    "no friction": ({BALL: 'condim="1"', FLOOR: 'condim="1"'}, {"low": 2.0, "high": 4.0}, r"no friction \(condim 1\)"),
    "friction by the other": ({BALL: 'condim="1"'}, {"low": 2.0, "high": 4.0}, None),
    "no friction by the first": ({BALL: 'condim="1" priority="1"'}, {"low": 2.0, "high": 4.0}, "condim 1"),
    "a body's own parts": (
        {},
        {"only": ["hat"], "low": 2.0, "high": 4.0},
        "no contact reads the friction of hat; .*ball",
    ),
    "a pair": ({"pair": ""}, {"low": 2.0, "high": 4.0}, "write pair_friction instead"),
}


@pytest.mark.parametrize(("extra", "section", "why"), SLIDING.values(), ids=list(SLIDING))
def test_friction_that_no_contact_reads_is_refused(
    extra: dict[str, str], section: dict[str, Any], why: str | None
) -> None:
    """What is refused changes no bit of what C MuJoCo computes, and what is accepted does."""
    pair = '<contact><pair geom1="floor" geom2="ball"/></contact>' if "pair" in extra else ""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><geom name="floor" type="plane" size="5 5 1" {extra.get(FLOOR, "")}/>
        <body pos="0 0 .099"><freejoint/><geom name="ball" size=".1" {extra.get(BALL, "")}/>
        <geom name="hat" size=".02" pos="0 0 .1" contype="2" conaffinity="2"/></body></worldbody>{pair}</mujoco>"""
    )
    if why is not None:
        with pytest.raises(ConfigError, match=f"physics.randomize.geom_friction: .*{why}") as caught:
            randomizer(model, geom_friction=section)
        assert "\n" not in str(caught.value)
    else:
        randomizer(model, geom_friction=section)
    if section.get("each"):
        return
    ends = []
    for factor in (section["low"], section["high"]):
        other = copy.copy(model)
        for name in section.get("only", (FLOOR, BALL, "hat")):
            other.geom(name).friction[0] *= factor
        data = mujoco.MjData(other)
        data.qvel[:3] = 3.0, 0.0, -1.0
        for _ in range(5):
            mujoco.mj_step(other, data)
        ends.append(data.qvel.copy())
    assert np.array_equal(*ends) == (why is not None)


def test_a_pair_without_friction_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom name="floor" type="plane" size="5 5 1"/><body pos="0 0 1"><freejoint/>
        <geom name="ball" size=".1"/></body></worldbody>
        <contact><pair name="touch" geom1="floor" geom2="ball" condim="1"/></contact></mujoco>"""
    )
    with pytest.raises(ConfigError, match=r"pair_friction: these pairs have no friction \(condim 1\); leave it out"):
        randomizer(model, pair_friction={"low": 0.5, "high": 1.5})
