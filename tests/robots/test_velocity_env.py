"""The velocity tasks beyond what mjlab's recorded steps show: starts, shares of commands, gradients."""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from slopes import check_slopes

from msk_ray.config import CommandSchedule, PhysicsConfig
from msk_ray.config.environments import settings_class
from msk_ray.envs import make_env
from msk_ray.errors import ConfigError
from msk_ray.robots.config import G1_TERMS, GO1_TERMS
from msk_ray.robots.env import Go1Velocity, VelocityEnv
from msk_ray.robots.robot import PoseSpread, by_joint
from msk_ray.robots.rough import Go1VelocityRough
from msk_ray.robots.servos import servos_of
from msk_ray.robots.terms import base_height, upright, variable_posture
from msk_ray.robots.unitree import GO1
from msk_ray.step import StepState

SCENES = Path(__file__).parents[2] / "msk_ray" / "robots" / "scenes"


def make(
    nworld: int,
    robot: str = "go1",
    *,
    differentiable: bool = False,
    randomize: Mapping[str, Any] | None = None,
    **changes: Any,
) -> VelocityEnv[Any]:
    name = f"{robot}_velocity"
    settings = settings_class(name)(name=name, **changes)
    physics = PhysicsConfig(randomize=randomize)
    env = make_env(settings, physics, nworld, "cpu", 0, differentiable=differentiable, randomize=True)
    assert isinstance(env, VelocityEnv)
    return env


def make_rough(nworld: int, **changes: Any) -> Go1VelocityRough:
    name = "go1_velocity_rough"
    settings = settings_class(name)(name=name, terrain_rows=2, **changes)
    env = make_env(settings, PhysicsConfig(), nworld, "cpu", 0, differentiable=False)
    assert isinstance(env, Go1VelocityRough)
    return env


def test_starts_and_commands_are_drawn_as_mjlab_draws_them() -> None:
    env = make(1)
    physics = env.draw_physics(4000)
    low, high = physics.qpos.amin(0), physics.qpos.amax(0)
    assert low[:3].tolist() == pytest.approx([-0.5, -0.5, 0.278 + 0.01], abs=2e-3)
    assert high[:3].tolist() == pytest.approx([0.5, 0.5, 0.278 + 0.05], abs=2e-3)
    assert (physics.qpos[:, 7:] == env.default_pose).all()
    assert not physics.qvel.any()
    yaw = 2.0 * torch.atan2(physics.qpos[:, 6], physics.qpos[:, 3])
    assert yaw.abs().max() > 3.1
    assert (yaw > 0).float().mean() == pytest.approx(0.5, abs=0.05)


def test_commands_have_mjlabs_ranges_and_shares() -> None:
    env = make(4000)
    command = env.velocity_command()
    standing = (command == 0.0).all(-1)
    assert standing.float().mean() == pytest.approx(0.1, abs=0.02)
    ahead = ~standing & (command[:, 1] == 0.0)
    assert ahead.float().mean() == pytest.approx(0.9 * 0.2, abs=0.02)
    assert command[ahead, 0].min() == pytest.approx(0.3)
    assert command[~ahead].amin(0).tolist() == pytest.approx([-1.5, -1.0, -0.7], abs=0.02)
    assert command.amax(0).tolist() == pytest.approx([2.0, 1.0, 0.7], abs=0.02)


def test_the_commanded_yaw_rate_turns_to_a_heading_the_shorter_way_round() -> None:
    north, never, always = math.pi / 2.0, [1.0, 1.0], [0.0, 0.0]
    kinds = {"stand": never, "go_ahead": never, "turn_to_heading": always, "heading": [north, north]}
    env = make(3, commands={"velocity": kinds})
    for world, yaw in enumerate((north - 0.4, -math.pi + 0.2, north + 0.1)):
        turn = torch.tensor([math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0)])
        env.state.physics.qpos[world, 3:7] = turn
    assert env.velocity_command()[:, 2].tolist() == pytest.approx([0.2, -0.7, -0.05], abs=1e-5)
    kinds["stand"] = always
    assert not make(3, commands={"velocity": kinds}).velocity_command().any()


def test_a_zero_action_stands_still() -> None:
    env = make(2, commands={"velocity": {"stand": (0.0, 0.0)}})
    for _ in range(25):
        step = env.step(torch.zeros(2, 12))
    terms = dict(zip(env.reward_names, step.terms[0].tolist(), strict=True))
    assert terms["track_linear_velocity"] > 1.8
    assert terms["upright"] > 0.9
    times = env.air_time()
    assert times.contact.min() > 0.2
    assert not times.air.any()


def test_a_tail_gives_tracking_terms_a_slope_in_training_but_not_in_scores() -> None:
    far = {"commands": {"velocity": {"stand": (1.0, 1.0), "lin_vel_x": (2.0, 2.0)}}}
    plain, tailed = make(1, **far), make(1, reward={"tail": 0.5}, **far)
    still, close = (env.step(torch.zeros(1, 12)).terms[0, 0].item() for env in (plain, tailed))
    assert still < 1e-4
    assert close == pytest.approx(2.0 * 0.5 / (1.0 + 4.0 / 0.25), rel=0.5)
    assert type(tailed).reference_settings(tailed.config).reward.tail == 0.0


def test_a_pose_tail_gives_pose_terms_a_slope_in_training_but_not_in_scores() -> None:
    """Every joint is three spreads away, the trunk lies on its side: x is 9, and 1 / 0.2."""
    plain, tailed = make(1), make(1, reward={"pose_tail": 0.25})
    for env, share in ((plain, 0.0), (tailed, 0.25)):
        end = env.state.physics
        joints = env.default_pose + 3.0 * env.pose_spread()
        lying = torch.tensor([[0.5**0.5, 0.5**0.5, 0.0, 0.0]])
        end = end._replace(qpos=torch.cat((end.qpos[:, :3], lying, joints), dim=-1))
        for term, x in ((variable_posture, 9.0), (upright, 5.0)):
            value = term(env, end, end.qpos, end.qpos).item()
            assert value == pytest.approx((1.0 - share) * math.exp(-x) + share / (1.0 + x), rel=1e-4)
    assert type(tailed).reference_settings(tailed.config).reward.pose_tail == 0.0


def test_late_observations_show_the_last_action_and_the_command_of_now() -> None:
    """The policy does not measure what it did and what it is asked to do."""
    env = make(2, randomize={"observation_delay": [1, 1]})
    env.step(torch.full((2, env.action_size), 0.25))
    before = env.observe(env.state.physics, env.state.action)
    env.step(torch.full((2, env.action_size), 0.5))
    now = env.observe(env.state.physics, env.state.action)
    known = torch.tensor([entry.known for entry in env.observation_layout()])
    assert int(known.sum()) == env.action_size + 3
    assert torch.equal(env.observation(), torch.where(known, now, before))


def test_commands_widen_in_training_but_not_in_scores() -> None:
    schedule = CommandSchedule(start=0.5, begin=100, end=200)
    env, scored = (make(64, "g1", command_schedule=schedule) for _ in range(2))
    for epoch, share in ((0, 0.5), (150, 0.75), (200, 1.0)):
        env.enter_epoch(epoch)
        low, high = env.command_ranges["velocity"][:, :4].tolist()
        assert low == pytest.approx([-1.5 * share, -share, -0.7 * share, -math.pi], rel=1e-6)
        assert high == pytest.approx([2.0 * share, share, 0.7 * share, math.pi], rel=1e-6)
    assert scored.command_ranges["velocity"][1, 0] == 2.0


class Curriculum(Go1Velocity):
    """Has a curriculum of its own."""

    begin_epoch_in_place = True

    def begin_epoch(self, epoch: int) -> None:
        self.command_ranges["velocity"][1, 1] = 0.25


def test_a_class_with_its_own_curriculum_keeps_the_schedule_of_commands() -> None:
    schedule = CommandSchedule(start=0.5, begin=5, end=9)
    settings = Curriculum.Settings(name="own", command_schedule=schedule)
    env = Curriculum(settings, PhysicsConfig(), 1, "cpu", 0, None)
    env.enter_epoch(0)
    assert env.command_ranges["velocity"][1, :3].tolist() == pytest.approx([1.0, 0.25, 0.35])


def test_a_schedule_that_never_rises_is_refused() -> None:
    with pytest.raises(ValueError, match="greater than begin"):
        CommandSchedule(start=0.1, begin=500, end=500)


@pytest.mark.parametrize("robot", ["go1", "g1"])
def test_gradients_of_reward_and_observation_match_finite_differences(robot: str) -> None:
    env = make(1, robot, commands={"velocity": {"stand": (1.0, 1.0), "lin_vel_x": (0.5, 0.5)}}, reward={"tail": 0.5})
    rng = np.random.default_rng(3)
    parts = [part[0].numpy().astype(float) for part in env.state.physics[:2]]
    parts[0][3:7] += 0.1 * rng.normal(size=4)
    parts[0][3:7] /= np.linalg.norm(parts[0][3:7])
    parts[0][7:] += 0.1 * rng.normal(size=env.action_size)
    parts[1] += 0.3 * rng.normal(size=parts[1].size)
    action = torch.zeros(1, env.action_size)
    weights = torch.tensor(rng.normal(size=env.obs_size), dtype=torch.float32)
    env.measurements.ignore_contact_forces = True

    def value(arrays: list[torch.Tensor]) -> torch.Tensor:
        state = StepState(*arrays, env.state.physics.act)
        env.next_memory = dict(env.remember(state, action))
        obs = env.observe(state, action)
        return (obs * weights).sum() + env.reward_terms(state, action, obs).sum()

    check_slopes(value, parts, rng)


class Own(VelocityEnv[Any]):
    """A robot of a user's."""

    mjcf = str(SCENES / "go1_flat.xml")
    robot = replace(GO1, pose_spread=PoseSpread(standing={".*": 0.05}, walking={".*": 0.3}, running={".*": 0.5}))
    terms = G1_TERMS


def test_a_derived_class_has_the_terms_it_lists() -> None:
    env = Own(Own.Settings(name="own"), PhysicsConfig(), 2, "cpu", 0, None)
    assert {"angular_momentum", "self_collisions"} < set(env.reward_names)
    step = env.step(torch.zeros(2, 12))
    assert step.terms.shape == (2, len(G1_TERMS) - 2), "air_time and base_height have no weight"
    assert torch.isfinite(step.terms).all()


def test_each_joint_must_match_one_pattern_of_the_pose_spread() -> None:
    assert by_joint({".*hip": 1.0, "knee": 2.0}, ("left_hip", "knee")) == [1.0, 2.0]
    with pytest.raises(ConfigError, match="no pattern matches joint 'ankle'"):
        by_joint({"hip": 1.0}, ("hip", "ankle"))
    with pytest.raises(ConfigError, match="2 patterns match joint 'hip'"):
        by_joint({"hip": 1.0, "h.*": 2.0}, ("hip",))


SERVO = '<position joint="knee" kp="50" forcerange="-40 40"/>'


@pytest.mark.parametrize(
    ("joint", "servo", "message"),
    [
        ("", SERVO, "first joint is free"),
        ("<freejoint/>", "", "joint 'knee' needs a position servo with a force range"),
        ("<freejoint/>", SERVO.replace('forcerange="-40 40"', ""), "force range"),
        ("<freejoint/>", SERVO.replace("position", "motor").replace('kp="50"', ""), "position servo"),
    ],
)
def test_a_model_without_a_servo_on_each_hinge_is_refused(joint: str, servo: str, message: str) -> None:
    """Without a force range, no action would move anything."""
    xml = (
        f'<mujoco><worldbody><body>{joint}<geom size="0.1"/><body pos="0 0 -0.2"><joint name="knee"/><geom size="0.1"/>'
        f"</body></body></worldbody><actuator>{servo}</actuator></mujoco>"
    )
    with pytest.raises(ConfigError, match=message):
        servos_of(mujoco.MjModel.from_xml_string(xml))


def changed(edits: dict[str, str], **attributes: Any) -> Own:
    """A user's robot whose MJCF is Go1's with other texts."""
    text = (SCENES / "go1_flat.xml").read_text()
    for pattern, new in edits.items():
        text, count = re.subn(pattern, new, text, flags=re.DOTALL)
        assert count, pattern
    kind = type("Changed", (Own,), {"mjcf": text, "terms": GO1_TERMS, **attributes})
    return kind(kind.Settings(name="changed"), PhysicsConfig(), 1, "cpu", 0, None)


def test_a_robot_without_a_default_pose_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"model of Changed has no keyframe .* write in the MJCF <keyframe>.* 19 numbers"
    ):
        changed({"<keyframe>.*</keyframe>": "", '<size nkey="1"/>': ""})


def test_a_default_pose_outside_the_range_of_a_joint_is_refused() -> None:
    message = (
        r"default pose of Changed: joint 'FR_hip_joint' is at 0.1 rad, outside its range -0.01506 to 0.01506 rad, and "
        r'so are 11 others: .*degrees unless <compiler angle="radian"/>'
    )
    with pytest.raises(ConfigError, match=message):
        changed({'<compiler angle="radian"/>': ""})


def test_one_error_lists_all_names_that_a_model_lacks() -> None:
    wrong = replace(GO1, base="pelvis", feet=("FR", "left", "right"), foot_parts=("toe",))
    edits = {'body name="terrain"': 'body name="floor"', 'body2="terrain"': 'body2="floor"', 'name="imu_ang_vel"': ""}
    with pytest.raises(ConfigError) as refused:
        changed(edits, robot=wrong)
    assert re.fullmatch(
        r"the model of Changed lacks what its robot names: no body 'pelvis', 'terrain' \(with the ground\) "
        r"\(it has world, floor, trunk, .*\); no site 'left', 'right' \(it has head, imu, FR, FL, RR, RL\); "
        r"no geom 'toe' \(it has terrain, .*\.\.\.\); no sensor 'imu_ang_vel' \(gyro\) \(it has imu_lin_vel, .*\)",
        str(refused.value),
    )


def test_missing_sensors_are_an_error_only_if_they_are_observed() -> None:
    without = {'name="imu_ang_vel"': "", 'name="imu_lin_vel"': ""}
    with pytest.raises(ConfigError, match=r"no sensor 'imu_lin_vel' \(velocimeter\), 'imu_ang_vel' \(gyro\)"):
        changed(without)
    env = changed(without, observe=lambda self, state, action: state.qpos)
    assert torch.isfinite(env.step(torch.zeros(1, 12)).reward).all()


def test_episodes_end_at_a_low_base_in_training_but_not_in_scores() -> None:
    env = make(3, "g1", termination_height=0.57)
    state = env.state.physics
    qpos = state.qpos.clone()
    qpos[:, 2] = torch.tensor([0.58, 0.56, 0.76])
    assert env.fell(state._replace(qpos=qpos)).tolist() == [False, True, False]
    height = base_height(env, state._replace(qpos=qpos), torch.zeros(3, 29), torch.zeros(3, 1))
    assert height.tolist() == pytest.approx([math.exp(-3.24), math.exp(-4.0), 1.0], abs=1e-5)
    assert type(env).reference_settings(env.config).termination_height == 0.0


def test_a_step_scans_rough_ground_once(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_rough(4)
    counts = []
    below = env.ground.below
    monkeypatch.setattr(
        env.ground, "below", lambda points, reach: counts.append(points.shape[1]) or below(points, reach)
    )
    env.step(torch.zeros(4, env.action_size))
    assert counts.count(len(env.scan_points)) == 1


def test_base_height_on_rough_ground_is_measured_from_the_ground_below() -> None:
    env = make(4, "go1")
    rough = make_rough(4, termination_height=0.14)
    state = rough.state.physics
    height = rough.base_height(state)
    assert (height - (env.model.key_qpos[0, 2] + 0.03)).abs().max() < 0.15
    assert not rough.is_low(state).any()
    lower = state.qpos.clone()
    lower[:, 2] -= 0.6 * height
    assert rough.is_low(state._replace(qpos=lower)).all()
