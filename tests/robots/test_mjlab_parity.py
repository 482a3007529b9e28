"""Models, observations, rewards and falls of the velocity tasks against those recorded from unmodified mjlab 1.6.0.

`tests/fixtures/mjlab/record.py` has recorded them.
"""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.config.environments import settings_class
from msk_ray.envs import make_env
from msk_ray.envs.records import EnvState
from msk_ray.robots.env import VelocityEnv
from msk_ray.step import StepState
from msk_ray.step.autograd.contact_state import AirTime

RECORDED = Path(__file__).parents[1] / "fixtures" / "mjlab"
SCENES = Path(__file__).parents[2] / "msk_ray" / "robots" / "scenes"
ROBOTS = ("go1", "g1")
TASKS = {"go1": "go1_velocity", "g1": "g1_velocity", "go1_rough": "go1_velocity_rough"}
ROUGH_ROWS = 4
OF_JOINTS = ("pose", "dof_pos_limits")
"""Terms of the joints, which mjlab measures at the end of a step; it measures bodies a substep before."""
OF_A_STEP = (*OF_JOINTS, "action_rate_l2", "air_time", "foot_swing_height", "soft_landing")
"""Terms that do not depend on when in a step bodies are measured."""
OF_CONTACTS = ("self_collisions", "shank_collision", "trunk_head_collision")
"""Terms that count contacts. Of several contacts of a part, mjlab sees one."""


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_model_is_mjlabs_in_every_field(robot: str) -> None:
    model = mujoco.MjModel.from_xml_path(str(SCENES / f"{robot}_flat.xml"))
    with np.load(RECORDED / f"{robot}_model.npz") as recorded:
        assert len(recorded.files) > 70
        for field in recorded:
            kind, _, name = field.partition("_")
            if name == "names":
                ours: Any = [getattr(model, kind)(i).name for i in range(len(recorded[field]))]
                assert ours == list(recorded[field]), field
            else:
                ours = getattr(model.opt, name) if kind == "opt" else getattr(model, field)
                ours = ours[0] if kind == "key" else ours
                np.testing.assert_allclose(ours, recorded[field], rtol=1e-5, atol=1e-7, err_msg=field)


class Recorded:
    """The recorded steps of a robot, and an environment with a world for each, in the state that it began with."""

    def __init__(self, robot: str) -> None:
        with np.load(RECORDED / f"{robot}_steps.npz") as arrays:
            self.constants = {name: arrays[name] for name in ("term_names", "term_weights", "joint_names")}
            self.steps = {
                name: torch.from_numpy(arrays[name].reshape(-1, *arrays[name].shape[2:]))
                for name in arrays.files
                if arrays[name].ndim > 1 and name != "soft_limits"
            }
            self.action_scale, self.soft_limits = arrays["action_scale"], arrays["soft_limits"]
        name = TASKS[robot]
        self.rough = robot == "go1_rough"
        settings = settings_class(name)(name=name, **({"terrain_rows": ROUGH_ROWS} if self.rough else {}))
        count = len(self.steps["reward"])
        weights = dict.fromkeys(("air_time", "body_ang_vel", "angular_momentum"), 1.0)
        reward = settings.reward.model_copy(update=weights)
        env = make_env(
            settings.model_copy(update={"reward": reward}), PhysicsConfig(), count, "cpu", 0, differentiable=False
        )
        assert isinstance(env, VelocityEnv)
        self.env = env
        self.kept = ~self.steps["terminated"]
        """Steps (N,) that no reset has followed."""
        began = StepState(self["began_qpos"], self["began_qvel"], env.state.physics.act)
        never = torch.zeros_like(self["began_air_time"])
        times = AirTime(self["began_air_time"], self["began_contact_time"], never, never)
        heights = {name: self[f"began_{name}"] for name in ("foot_height", "peak_height")}
        memory = {"air_time": times.memory, **heights}
        env.state = EnvState(began, self["began_previous_action"], env.state.age, env.state.numbers, memory)

    def __getitem__(self, name: str) -> Tensor:
        return self.steps[name]

    def state(self, kind: str = "") -> StepState:
        """The states at the end, or `measured_` ones, one substep before."""
        return StepState(self[f"{kind}qpos"], self[f"{kind}qvel"], self.env.state.physics.act)


@pytest.fixture(params=[*ROBOTS, pytest.param("go1_rough", marks=pytest.mark.slow)])
def recorded(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Recorded:
    steps = Recorded(request.param)
    monkeypatch.setattr(steps.env, "velocity_command", lambda: steps["began_command"])
    return steps


def test_joints_and_actions_are_mjlabs(recorded: Recorded) -> None:
    env = recorded.env
    assert env.joint_names == env.action_names() == list(recorded.constants["joint_names"])
    np.testing.assert_allclose(env.action_scale, recorded.action_scale, rtol=1e-5)
    np.testing.assert_allclose(torch.stack(env.joint_limits, -1), recorded.soft_limits, atol=1e-5)


def test_the_observation_is_mjlabs(recorded: Recorded) -> None:
    env = recorded.env
    torch.testing.assert_close(env.observation(), recorded["began_obs"], atol=1e-3, rtol=0.0)
    layout = env.observation_layout()
    assert layout is not None
    assert len(layout) == env.obs_size == recorded["obs"].shape[1]
    heights = env.foot_heights(env.state.physics)
    torch.testing.assert_close(heights, recorded["began_foot_height"], atol=1e-4, rtol=0.0)


def test_each_term_is_mjlabs(recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    env, kept, terms = recorded.env, recorded.kept, recorded["terms"]
    names = list(recorded.constants["term_names"])
    weights = dict(zip(names, recorded.constants["term_weights"].tolist(), strict=True))
    never = torch.zeros_like(recorded["air_time"])
    times = AirTime(recorded["air_time"], recorded["contact_time"], never, never)
    env.next_memory = {"air_time": times.memory}
    force = SimpleNamespace(force=recorded["measured_contact_force"])
    monkeypatch.setattr(env, "foot_contact", lambda state: force)
    measured, end = recorded.state("measured_"), recorded.state()
    of_states = [term for term in env.active_terms if term.name not in OF_CONTACTS]
    for term in of_states:
        state = end if term.name in OF_JOINTS else measured
        ours = term.measure(env, state, recorded["action"], recorded["obs"])
        theirs = terms[:, names.index(term.name)]
        # mjlab scans rough ground for `upright` once a step.
        atol = 5e-3 if recorded.rough and term.name == "upright" else 1e-3
        torch.testing.assert_close(
            ours[kept], theirs[kept], atol=atol, rtol=1e-5, msg=lambda m, t=term: f"{t.name} {m}"
        )
        assert theirs[kept].std() > 1e-3, f"{term.name} is the same in all recorded steps"
        default = type(env.config.reward)().model_dump()[term.setting]
        assert default == pytest.approx(weights[term.name]), term.name
    assert {term.name for term in env.active_terms} == set(names)
    assert recorded["terminated"].any()


def test_a_step_is_mjlabs(recorded: Recorded) -> None:
    """From the recorded states, with this package's physics, which lets the solver converge."""
    env, kept = recorded.env, recorded.kept
    found = env.step(recorded["action"], auto_reset=False)
    command = slice(env.obs_size - 190, env.obs_size - 187) if recorded.rough else slice(-3, None)
    obs = found.obs.clone()
    obs[:, command] = recorded["obs"][:, command]  # the next command is not this one
    assert torch.equal(found.terminated, recorded["terminated"])
    close = ((obs - recorded["obs"]).abs() <= 1e-3).all(-1)
    # Where a foot touches a height field in many places, mjlab's solver stops far from its minimum.
    assert close[kept].float().mean() > 0.95 if recorded.rough else close[kept].all()
    kept = kept & close
    names = list(recorded.constants["term_names"])
    for k, term in enumerate(env.active_terms):
        ours = (found.terms[:, k] / term.weight_in(env.config.reward))[kept]
        theirs = recorded["terms"][kept, names.index(term.name)]
        if term.name in OF_A_STEP:
            assert (ours - theirs).abs().max() <= 1e-3 + 1e-5 * theirs.abs().max(), term.name
        elif term.name in OF_CONTACTS:
            ours, theirs = ours.round(), theirs.round()
            assert (ours >= theirs).all(), term.name
            assert (ours == theirs).float().mean() > 0.9, term.name
            assert theirs.max() == 4.0 or recorded.rough
    times = AirTime.of(env.memory["air_time"])
    for value, name in ((times.air, "air_time"), (times.contact, "contact_time")):
        torch.testing.assert_close(value[kept], recorded[name][kept], atol=1e-6, rtol=0.0)
    torch.testing.assert_close(env.memory["peak_height"][kept], recorded["peak_height"][kept], atol=1e-5, rtol=0.0)
    heights = recorded["critic_obs"][:, env.obs_size :][:, : len(env.robot.feet)]
    torch.testing.assert_close(env.memory["foot_height"][kept], heights[kept], atol=1e-3, rtol=0.0)
