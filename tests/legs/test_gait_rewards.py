"""The clock, the mirror, the reference motion and the further rewards of the legs."""

import math

import mujoco
import numpy as np
import pytest
import torch
from pydantic import ValidationError

from msk_ray.config import PhysicsConfig
from msk_ray.envs import make_env
from msk_ray.envs.records import EnvState
from msk_ray.errors import ConfigError
from msk_ray.legs import costs
from msk_ray.legs.clock import fourier, series, window
from msk_ray.legs.config import LegReward
from msk_ray.legs.metabolic import Fibres, muscle_masses, power
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.legs.myoleg26.env import MyoLeg26
from msk_ray.legs.reference import people_angles, sway
from msk_ray.legs.regular_pushes import pushes
from msk_ray.legs.terms import toes, track, track_rate
from msk_ray.step import StepState

EVERY = dict.fromkeys(("metabolic", "head", "impact", "footfall", "clearance", "toes", "vault"), 0.1)
EVERY |= {"out_of_plane": 0.1, "track": 0.5, "track_rate": 0.1, "landing": 0.1}


def make(nworld: int = 4, **settings: object) -> MyoLeg26:
    config = MyoLeg26Settings.model_validate({"name": "myoleg26", **settings})
    return make_env(config, PhysicsConfig(), nworld, "cpu", 0, differentiable=True)


@pytest.fixture(scope="module")
def env() -> MyoLeg26:
    return make(clock=True, symmetric=True, reset="cycle", speed_range=[1.0, 1.5], reward=EVERY)


def fresh(env: MyoLeg26) -> EnvState:
    env.generator.manual_seed(0)
    env.state = env.reset_state()
    return env.state


def test_metabolic_power_by_hand() -> None:
    """Bhargava et al. 2004, for muscles of 2 kg, half slow and half fast."""
    at = torch.tensor([[0.0, 1.0, 1.0, 1.0]])
    length = torch.tensor([[1.0, 1.0, 1.25, 0.4]])
    rate = torch.tensor([[0.0, -0.1, 0.2, 0.0]])
    force, isometric = torch.tensor([[0.0, 800.0, 1200.0, 0.0]]), torch.tensor([[0.0, 1000.0, 1000.0, 0.0]])
    found = power(Fibres(at, at, length, rate, force, isometric), torch.full((4,), 2.0))[0]
    activation, maintenance = 2.0 * (20.0 + 66.5), 2.0 * (37.0 + 55.5)
    assert found.tolist() == pytest.approx(
        [
            2.0,  # nothing but the least heat, 1 W/kg
            activation + maintenance + 0.1 * (0.16 * 1000 + 0.18 * 800) + 80.0,
            activation + 0.5 * maintenance - 0.2 * 0.157 * 1200 - 240.0,
            activation + 0.5 * maintenance,
        ]
    )
    # 250 N need 10 cm² of 0.1 m: 0.1 l of muscle
    assert muscle_masses(torch.tensor([250.0]), torch.tensor([0.1])).item() == pytest.approx(1059.7 * 1e-3 * 0.1)


def test_costs_by_hand() -> None:
    phase = torch.tensor([0.2, 0.5, 0.8])
    moving, still = torch.tensor([[0.4, 0.0, 0.0]] * 3), torch.zeros(3, 3)
    once = math.hypot(1.0, 0.4 / 0.3) - 1.0
    assert costs.sliding(phase, moving, still).tolist() == pytest.approx([once, 0.0, 0.0])
    assert costs.sliding(phase, still, moving).tolist() == pytest.approx([once, once, 0.0])
    heights = torch.tensor([[0.005, 0.02]] * 3)
    assert costs.dragging(phase, heights, 0.01).tolist() == pytest.approx([0.0, 0.0, 0.125])
    # 3.46 mm are √3 × 2 mm; half a flank before the window is open, and in the air for the rest of the cycle.
    struck = torch.tensor([0.05, -0.02, 0.05, 0.5, 0.95])
    heel = torch.tensor([0.002 * math.sqrt(3.0)] * 2 + [-0.002] + [0.01] * 2)
    assert costs.hovering(struck, heel).tolist() == pytest.approx([1.0, 0.5, 0.0, 0.0, 0.0], abs=1e-6)
    slope, bend = torch.full((3,), 0.2), torch.full((3,), 0.09)
    toes = costs.lifted_toes(phase, slope, bend).tolist()
    assert toes == pytest.approx([math.hypot(1.0, angle / 0.15) - 1.0 for angle in (0.2, 0.2, 0.3)])
    down = costs.impact(torch.tensor([[0.0, 0.03, 0.0]]), torch.tensor([[-2.0, -1.0, 1.0]]))
    assert down.item() == pytest.approx(4.0 + math.exp(-1.0))
    apart = costs.deviation(torch.tensor([[0.3, 0.0]]), torch.zeros(1, 2), 0.1)
    assert apart.item() == pytest.approx(math.sqrt(5.5) - 1.0)


def test_series_and_windows() -> None:
    turns = np.linspace(0.0, 1.0, 101)
    wave = 2.0 + 3.0 * np.cos(math.tau * turns) - 0.5 * np.sin(3 * math.tau * turns)
    value, slope = series(torch.tensor(fourier(wave))[None], torch.tensor([0.25, 1.25]))
    assert value[:, 0].tolist() == pytest.approx([2.5, 2.5])
    assert slope[:, 0].tolist() == pytest.approx([-6 * math.pi] * 2, rel=1e-5)
    found = window(torch.tensor([0.0, 0.02, 0.1, 0.2, 0.21, 0.9]), 0.0, 0.2)
    assert found.tolist() == pytest.approx([0.0, 0.5, 1.0, 0.0, 0.0, 0.0])


def test_people_step_as_far_as_they_were_measured_to() -> None:
    """The measured angles on the model's legs: feet stand still at 1.25 m/s, and steps are 0.64 m."""
    env = make(1, clock=True, reset="cycle", stochastic_reset=False)
    speed, phases = torch.full((20,), 1.25), torch.arange(20) / 20
    start = env.draw_phase(phases, speed)
    data = mujoco.MjData(env.model)
    sliding, apart = [], []
    for k in range(20):
        data.qpos[:], data.qvel[:] = start.qpos[k].numpy(), start.qvel[k].numpy()
        mujoco.mj_forward(env.model, data)
        apart.append(data.body("calcn_r").xpos[0] - data.body("calcn_l").xpos[0])
        velocity = np.zeros(6)
        body = env.model.body("toes_r").id
        mujoco.mj_objectVelocity(env.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
        if 0.15 < phases[k] < 0.5:
            sliding.append(np.linalg.norm(velocity[3:]))
    assert apart[0] == pytest.approx(0.644, abs=0.02)
    assert apart[10] == pytest.approx(-apart[0], abs=1e-3)
    assert max(sliding) < 0.15
    hip, knee, ankle = people_angles()
    assert (hip - knee + ankle)[10:31].mean() == pytest.approx(0.0, abs=1e-9)


def test_a_vaulting_body_rises_half_a_step_after_double_support(env: MyoLeg26) -> None:
    """4.0 cm at 1.25 m/s, 116.8 times a minute: up fastest an eighth of a cycle after the exchange of the feet."""
    phases, pace = torch.arange(1000) / 1000, env.reference.pace
    velocity = pace.vault(phases, torch.full((1000,), 1.25))
    height = velocity.cumsum(0) / 1000 / pace.strides_per_second(torch.tensor([1.25]))
    assert (height.max() - height.min()).item() == pytest.approx(0.0402, rel=0.01)
    assert velocity[:500].tolist() == pytest.approx(velocity[500:].tolist(), abs=1e-5), "the same for both legs"
    assert phases[velocity[:500].argmax()].item() == pytest.approx(0.06 + 0.125, abs=2e-3)
    assert pace.vault(torch.tensor([0.06, 0.31]), torch.tensor([0.7, 1.6])).abs().max() < 1e-5
    assert costs.vaulting(torch.tensor([0.3, 0.0]), torch.tensor([0.1, 0.0])).tolist() == pytest.approx(
        [math.sqrt(5.0) - 1.0, 0.0]
    )


def test_legs_out_of_the_plane_of_walking_cost_their_angles() -> None:
    """0.3 and 0 rad, twice and no times 0.15: √(1 + (4 + 0)/2) - 1; the model has hip rotations too, at 0 here."""
    found = costs.out_of_plane(torch.tensor([[0.3, 0.0], [0.0, 0.0]]))
    assert found.tolist() == pytest.approx([math.sqrt(3.0) - 1.0, 0.0])
    env = make(1, reward={"out_of_plane": 2.0})
    state = env.state.physics
    qpos = state.qpos.clone()
    for side, angle in (("r", -0.3), ("l", 0.0)):
        qpos[:, env.model.joint(f"hip_adduction_{side}").qposadr[0]] = angle
        qpos[:, env.model.joint(f"hip_rotation_{side}").qposadr[0]] = 0.0
    reward = env.reward_terms(state._replace(qpos=qpos), torch.zeros(1, env.action_size), env.observation())
    assert reward[0, env.reward_names.index("out_of_plane")].item() == pytest.approx(-2.0 * (math.sqrt(2.0) - 1.0))


def test_a_model_without_joints_out_of_the_plane_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("msk_ray.legs.env.OUT_OF_PLANE", ("elbow",))
    with pytest.raises(ConfigError, match=r"env\.reward\.out_of_plane: the model has none of the joints elbow"):
        make(1, reward={"out_of_plane": 1.0})


def test_the_pelvis_sways_between_feet_that_stay() -> None:
    """An inverted pendulum that is w from its foot when it gets there and w / cosh(T/2τ) halfway, T 60/116.8 s."""
    half, time = 0.5 * 60.0 / 116.8, math.sqrt(0.9 / 9.81)
    aside = sway(0.1, 0.9)
    assert aside.max() == pytest.approx(0.1 * (1.0 - 1.0 / math.cosh(half / time)), rel=0.01)
    assert aside.argmax() == 31
    assert aside[:50] == pytest.approx(-aside[50:100])
    slope = (aside[7] - aside[5]) / 0.02 / (2.0 * 2.0 * half)
    assert slope == pytest.approx(0.1 / time * math.tanh(half / time), rel=0.03), "m/s, towards the foot"
    env = make(1, clock=True, reset="cycle", stochastic_reset=False)
    start = env.draw_phase(torch.arange(20) / 20, torch.full((20,), 1.25))
    data, velocity, drift, speeds = mujoco.MjData(env.model), np.zeros(6), [], []
    for qpos, qvel in zip(start.qpos.numpy(), start.qvel.numpy(), strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(env.model, data)
        for side in "rl":
            body = env.model.body(f"calcn_{side}").id
            mujoco.mj_objectVelocity(env.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
            drift.append(abs(velocity[4]))
        speeds.append(qvel[env.model.joint("pelvis_tz").dofadr[0]])
    assert max(drift) < 0.01 < 0.15 < max(speeds)


def test_toes_are_level_on_the_ground_and_straight_in_the_air(env: MyoLeg26) -> None:
    """People's feet, whose toes are level until the swing; lifted by 0.4 rad, they cost as much at every phase."""
    fresh(env)
    numbers = torch.tensor([[1.25, phase] for phase in (0.2, 0.3, 0.7, 0.8)])
    start = env.draw_phase(numbers[:, 1], numbers[:, 0])
    lifted = start.qpos.clone()
    joints = [env.model.joint(f"mtp_angle_{side}").qposadr[0] for side in "rl"]
    start.qpos[:, joints] = torch.tensor(env.people_poses()[[20, 30, 70, 80]][:, joints], dtype=torch.float32)
    lifted[:, joints] = start.qpos[:, joints] + 0.4
    env.state = env.state._replace(numbers=numbers, age=torch.full((4,), -1))
    still = torch.zeros(4, 26)
    assert toes(env, start, still, still).max() < 0.1
    cost = toes(env, start._replace(qpos=lifted), still, still)
    assert cost.tolist() == pytest.approx([2.0 * (math.hypot(1.0, 0.4 / 0.15) - 1.0)] * 4, rel=0.12)


def test_initial_states_track_the_reference(env: MyoLeg26) -> None:
    """The clock, the reference and the initial states agree: at the start only noise is apart."""
    fresh(env)
    age = env.state.age.clone()
    env.state = env.state._replace(age=age - 1)  # rewards are for the state that a step leads to
    still = torch.zeros(4, 26)
    assert track(env, env.state.physics, still, still).max() < 0.02
    assert track_rate(env, env.state.physics, still, still).max() < 0.2
    behind = env.state.numbers.clone()
    behind[:, 1] += 0.2
    env.state = env.state._replace(numbers=behind)
    assert track(env, env.state.physics, still, still).min() > 0.2


def test_the_clock_turns_at_the_cadence_of_people_at_that_speed(env: MyoLeg26) -> None:
    state = fresh(env)
    speed = env.task_numbers(state.numbers)[:, 0]
    assert ((speed >= 1.0) & (speed <= 1.5)).all()
    assert speed.unique().numel() == 4
    second = env.phase(state.numbers, torch.full((4,), 50)) - env.phase(state.numbers, torch.zeros(4))
    at_1_25 = torch.tensor([[1.25, 0.0]])
    assert env._phase(at_1_25, torch.tensor([50])).item() * 120.0 == pytest.approx(116.5, abs=1.0)
    assert torch.equal(second.argsort(), speed.argsort())


def mirrored(env: MyoLeg26, state: StepState) -> StepState:
    def legs(values: torch.Tensor, signs: list[float]) -> torch.Tensor:
        half = (values.shape[1] - len(signs)) // 2
        root, right, left = values.split([len(signs), half, half], dim=1)
        return torch.cat((root * torch.tensor(signs), left, right), dim=1)

    root = [1.0, 1.0, -1.0, 1.0, -1.0, -1.0]
    return StepState(legs(state.qpos, root), legs(state.qvel, root), legs(state.act, []))


def test_half_a_cycle_later_the_mirror_image_looks_and_acts_the_same(env: MyoLeg26) -> None:
    state = fresh(env)
    action = torch.rand((4, 26), generator=torch.Generator().manual_seed(1)) - 0.5
    numbers = state.numbers.clone()
    numbers[:, 1] += 0.5
    seen = env.step(action, auto_reset=False)
    obs, physics = env.observation(), env.state.physics
    env.state = EnvState(mirrored(env, state.physics), state.action, state.age, numbers)
    other = env.step(action, auto_reset=False)
    torch.testing.assert_close(env.state.physics, mirrored(env, physics), atol=2e-4, rtol=1e-3)
    torch.testing.assert_close(env.observation(), obs, atol=2e-3, rtol=1e-2)
    torch.testing.assert_close(other.obs, env.observation())
    torch.testing.assert_close(other.terms, seen.terms, atol=2e-3, rtol=1e-2)


def test_every_further_term_has_a_gradient_and_none_is_there_by_default(env: MyoLeg26) -> None:
    fresh(env)
    assert make(1).reward_names == MyoLeg26.reward_names
    assert env.reward_names == (*MyoLeg26.reward_names, *EVERY)
    action = torch.zeros((4, 26), requires_grad=True)
    # Phases at which each term is at work in some world.
    numbers = torch.tensor([[1.25, phase] for phase in (0.0, 0.3, 0.7, 0.9)])
    env.state = env.state._replace(physics=env.draw_phase(numbers[:, 1], numbers[:, 0]), numbers=numbers)
    env.step(torch.tanh(action))
    env.state = env.state._replace(age=env.state.age - 1)  # the same phases again
    physics = env.state.physics
    worth = env.reward_terms(physics, action, env.observe(physics, action)).sum(0)
    for name, value in zip(env.reward_names[-len(EVERY) :], worth[-len(EVERY) :], strict=True):
        (slope,) = torch.autograd.grad(value, action, retain_graph=True)
        assert slope.isfinite().all(), name
        if name not in ("clearance", "landing"):  # people's feet are high enough, and their heels have landed
            assert slope.abs().max() > 1e-7, name


def test_a_heel_that_hovers_pulls_the_pelvis_down() -> None:
    env = make(1, clock=True, reset="cycle", stochastic_reset=False, reward={"landing": 1.0})
    physics = env.draw_phase(torch.tensor([0.03]), torch.tensor([1.25]))
    env.state = env.state._replace(physics=physics, numbers=torch.tensor([[1.25, 0.03]]))
    up = int(env.model.joint("pelvis_ty").qposadr[0])
    found = []
    for lifted in (0.0, 0.01):
        qpos = physics.qpos.clone()
        qpos[0, up] += lifted
        qpos.requires_grad_(True)
        state = physics._replace(qpos=qpos)
        cost = env.reward_terms(state, torch.zeros(1, 26), env.observe(state, torch.zeros(1, 26)))[0, -1]
        (slope,) = torch.autograd.grad(cost, qpos)
        found.append((cost.item(), slope[0, up].item()))
    assert found[1][0] < found[0][0] - 1.0
    assert found[1][1] < -100.0


def test_scores_are_at_the_target_speed_under_the_reference_reward(env: MyoLeg26) -> None:
    reference = MyoLeg26.reference_settings(env.config)
    assert reference.speed_range is None
    assert reference.reward == LegReward()
    assert reference.clock


def test_a_resumed_trial_keeps_speeds_and_phases(env: MyoLeg26) -> None:
    numbers = fresh(env).numbers
    saved = env.state_dict()
    env.state = env.reset_state()
    assert not torch.equal(env.state.numbers, numbers)
    env.load_state_dict(saved)
    assert torch.equal(env.state.numbers, numbers)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"reward": {"track": 1.0}}, "env.reward.track needs env.clock: write env.clock: true"),
        ({"symmetric": True}, "env.symmetric needs the phase of the walk"),
        ({"clock": True, "target_speed": 0.0}, "write an env.target_speed above 0"),
        ({"clock": True, "reset": "mixed"}, "write env.reset: cycle or stand"),
        ({"reset": "cycle"}, "write env.clock: true"),
        ({"speed_range": [1.5, 1.0]}, "write the smaller speed first"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        MyoLeg26Settings.model_validate({"name": "myoleg26", **settings})


def test_metabolic_power_of_standing_is_that_of_its_muscles(env: MyoLeg26) -> None:
    state = fresh(env)
    still = StepState(state.physics.qpos, torch.zeros_like(state.physics.qvel), state.physics.act)
    action = torch.zeros((4, 26))
    heat = env.metabolic_power(still, action) / env.mass
    assert ((heat > 0.5) & (heat < 4.0)).all()
    harder = env.metabolic_power(still._replace(act=torch.full_like(still.act, 0.5)), action) / env.mass
    assert (harder > heat + 5.0).all()


def test_pushes_change_the_speed_when_they_are_due() -> None:
    size = pushes(torch.tensor([0, 100, 150, 200]), 100, 0.5)
    assert size.norm(dim=-1).tolist() == pytest.approx([0.0, 0.5, 0.0, 0.5])
    assert size[1].tolist() != size[3].tolist()
    env = make(2, push={"speed": 0.4, "interval": 0.06}, stochastic_reset=False)
    state = env.state.physics
    assert env.disturbed(state) is not state
    torch.testing.assert_close(env.disturbed(state).qvel, state.qvel)
    env.state = env.state._replace(age=torch.tensor([3, 4]))
    pushed = env.disturbed(state).qvel - state.qvel
    assert pushed[1].abs().max() == 0.0
    # forward, up, right: a push is level, and (forward, left) as its direction says
    forward, left = pushes(torch.tensor([3, 4]), 3, 0.4)[0].tolist()
    assert pushed[0, :3].tolist() == pytest.approx([forward, 0.0, -left])
    assert pushed[0, 3:].abs().max() == 0.0
