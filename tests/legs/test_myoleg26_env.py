"""Standing and walking with 26 muscles: documented numbers, and the faults of published muscle environments."""

import math

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.config import PhysicsConfig, parse_config
from msk_ray.envs import make_env
from msk_ray.envs.reward import WeightedTerms
from msk_ray.errors import ConfigError
from msk_ray.legs.assistance import Assistance
from msk_ray.legs.config import AssistConfig, LegReward
from msk_ray.legs.costs import stride_error
from msk_ray.legs.muscles import MuscleCurves
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.legs.myoleg26.env import MyoLeg26
from msk_ray.step import StepState


def make(nworld: int = 2, *, differentiable: bool = False, **settings: object) -> MyoLeg26:
    config = MyoLeg26Settings.model_validate({"name": "myoleg26", **settings})
    return make_env(config, PhysicsConfig(), nworld, "cpu", 0, differentiable=differentiable)


@pytest.fixture(scope="module")
def env() -> MyoLeg26:
    return make(stochastic_reset=False)


def standing(env: MyoLeg26, **coordinates: float) -> StepState:
    """The standing state with some coordinates (names of joints) or velocities (`v_` names) set."""
    state = StepState(*(part.clone() for part in env.draw_physics(env.nworld)))
    for name, value in coordinates.items():
        if name.startswith("v_"):
            state.qvel[:, env.model.joint(name[2:]).dofadr[0]] = value
        else:
            state.qpos[:, env.model.joint(name).qposadr[0]] = value
    return state


def terms(env: MyoLeg26, state: StepState, action: torch.Tensor | None = None) -> dict[str, float]:
    action = torch.zeros((env.nworld, 26)) if action is None else action
    values = env.reward_terms(state, action, env.observe(state, action))
    return dict(zip(env.reward_names, values[0].tolist(), strict=True))


@pytest.mark.parametrize("coordinate", ["pelvis_tilt", "pelvis_list"])
@pytest.mark.parametrize("angle", [-1.0, -0.5, 0.5, 1.0])
def test_toppling_to_any_side_costs_uprightness(env: MyoLeg26, coordinate: str, angle: float) -> None:
    """Fault: "up" measured along a body axis that rewards toppling sideways."""
    upright = terms(env, standing(env, pelvis_tilt=0.0))["upright"]
    toppled = terms(env, standing(env, **{"pelvis_tilt": 0.0, coordinate: angle}))["upright"]
    assert upright == pytest.approx(env.config.reward.upright)
    assert toppled == pytest.approx(env.config.reward.upright * math.cos(angle), rel=1e-5)


def test_up_heading_and_spin_agree_with_the_body_in_c_mujoco(env: MyoLeg26) -> None:
    rng = np.random.default_rng(0)
    state = standing(env)
    state.qpos[:, 3:6] = torch.tensor(rng.normal(size=3))
    state.qvel[:, :6] = torch.tensor(rng.normal(size=6))
    data = mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:] = state.qpos[0].numpy(), state.qvel[0].numpy()
    mujoco.mj_forward(env.model, data)
    axes = data.body("pelvis").xmat.reshape(3, 3)
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(env.model, data, mujoco.mjtObj.mjOBJ_BODY, env.model.body("pelvis").id, velocity, 0)
    root = env.root(state)
    assert root.up[0].tolist() == pytest.approx(axes[:, 1].tolist(), abs=1e-6)
    assert root.heading[0].item() == pytest.approx(axes[0, 0], abs=1e-6)
    assert root.velocity[0].tolist() == pytest.approx(state.qvel[0, [0, 2, 1]].mul(torch.tensor([1, -1, 1])).tolist())
    assert root.spin[0].tolist() == pytest.approx(velocity[:3].tolist(), abs=1e-5)


def test_effort_grows_with_activation_from_rest(env: MyoLeg26) -> None:
    """Fault: effort measured around half activation, which rewards tensing every muscle."""
    found = []
    for activation in (0.0, 0.2, 0.5, 1.0):
        state = standing(env)
        found.append(terms(env, state._replace(act=torch.full_like(state.act, activation)))["effort"])
    weight = env.config.reward.effort
    assert found == pytest.approx([0.0, -0.04 * weight, -0.25 * weight, -weight])


def test_forward_is_where_the_toes_point(env: MyoLeg26) -> None:
    """Fault: a reward along an axis the model does not walk along."""
    data = mujoco.MjData(env.model)
    mujoco.mj_resetDataKeyframe(env.model, data, 0)
    mujoco.mj_forward(env.model, data)
    for side in "rl":
        foot = data.body(f"toes_{side}").xpos - data.body(f"calcn_{side}").xpos
        assert foot[0] / np.linalg.norm(foot) > 0.99
    # and the knees bend backward
    data.qpos[env.model.joint("knee_angle_r").qposadr] = -1.0
    before = data.body("talus_r").xpos[0]
    mujoco.mj_forward(env.model, data)
    assert data.body("talus_r").xpos[0] < before - 0.2
    target = env.config.target_speed
    assert terms(env, standing(env, v_pelvis_tx=target))["forward_vel"] == pytest.approx(env.config.reward.forward_vel)
    sideways, backward = standing(env, v_pelvis_tz=target), standing(env, v_pelvis_tx=-target)
    still = terms(env, standing(env))["forward_vel"]
    assert terms(env, sideways)["forward_vel"] == pytest.approx(still)
    assert terms(env, backward)["forward_vel"] < still


@pytest.mark.parametrize("reset", ["stand", "walk", "mixed"])
def test_resets_break_no_constraint(reset: str) -> None:
    """Fault: reset noise that violates what the model's constraints hold together."""
    env = make(64, reset=reset, reset_noise=0.1)
    model, data = env.model, mujoco.MjData(env.model)
    assert model.neq == 0
    qpos, qvel, act = env.state.physics
    low, high = (torch.tensor(bound, dtype=torch.float32) for bound in model.jnt_range[6:].T)
    assert (qpos[:, 6:] >= low).all()
    assert (qpos[:, 6:] <= high).all()
    assert ((act >= 0) & (act <= 1)).all()
    deepest = 0.0
    for row in qpos.numpy():
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        deepest = min(deepest, data.contact.dist[: data.ncon].min(initial=0.0))
    assert deepest > -0.06
    if reset == "mixed":
        assert set((qvel[:, 0] > 0.6).tolist()) == {True, False}


def test_excitations_are_squashed_with_a_slope_everywhere(env: MyoLeg26) -> None:
    """Fault: clipped excitations, whose slope is zero beyond the clip."""
    action = torch.tensor([[-1.0, -0.99, 0.0, 0.99, 1.0]]).T.repeat(1, 26).requires_grad_()
    excitation = env.excitation(action)
    expected = [0.0, 0.005 / (0.005 + 49 * 0.995), 0.02, 0.995 / (0.995 + 49 * 0.005), 1.0]
    assert excitation[:, 0].tolist() == pytest.approx(expected, rel=1e-4)
    (slope,) = torch.autograd.grad(excitation.sum(), action)
    assert (slope > 0.005).all()


def test_reward_by_hand(env: MyoLeg26) -> None:
    env.state = env.reset_state()
    state = standing(
        env, pelvis_tilt=0.0, pelvis_ty=env.stand_height - 0.1, knee_angle_r=0.1, knee_angle_l=-0.5,
        hip_flexion_r=0.3, hip_flexion_l=0.0,
        v_pelvis_tz=0.5, v_pelvis_list=2.0, v_hip_flexion_r=1.0, v_hip_flexion_l=2.0,
    )  # fmt: skip
    state.act.fill_(0.5)
    with pytest.MonkeyPatch.context() as patch:
        reward = LegReward(symmetry=0.1, progress=0.5, stride=0.5)
        patch.setattr(env, "weighted_terms", WeightedTerms.of(env.active_terms, reward, env.device))
        found = terms(env, state, torch.full((2, 26), 0.5))
    # 0.5 m/s to the right, and a trunk that turns rightward by 2 rad/s
    lateral = (0.5 + 0.18 * 2.0) * math.sqrt(env.stand_height / 9.81)
    assert found == pytest.approx(
        {
            "forward_vel": math.exp(-((1.25 / 0.6) ** 2)), "progress": 0.0, "upright": 2.0, "heading": 0.2,
            "height": -5.0 * 0.01, "alive": 0.5, "effort": -0.2 * 0.25,
            "joint_limit": -0.1 * 1.5**2, "smoothness": -0.02 * 0.25,
            "capture": -0.3 * (math.hypot(1.0, lateral / 0.1) - 1.0), "sway": -0.02 * 4.0,
            "symmetry": -0.1 * 9.0,
            # d = 0.3 of 0.75 rad; d' = -1 of 0.75 * 2π * 112 / 120 rad/s
            "stride": -0.5 * (math.hypot(0.4, 0.2274, 0.01) - 1.0) ** 2,
        },
        rel=1e-4, abs=1e-6,
    )  # fmt: skip


def test_legs_that_swing_as_a_pendulum_pay_nothing_for_their_stride(env: MyoLeg26) -> None:
    time = torch.linspace(0.0, 1.2, 60)
    rate = math.tau * 112 / 120
    swing, speed = 0.375 * torch.sin(rate * time), 0.375 * rate * torch.cos(rate * time)
    walking = stride_error(torch.stack((swing, -swing), -1), torch.stack((speed, -speed), -1), 0.75, rate)
    assert walking.max() < 1e-6
    # Four times as quick and as small: as fast in the middle, all but still where it turns.
    quick = stride_error(torch.stack((swing, -swing), -1) / 4, torch.stack((speed, -speed), -1), 0.75, rate)
    assert quick.min() < 1e-3
    assert quick.max() > 0.5


def test_observation_is_in_the_documented_order(env: MyoLeg26) -> None:
    rng = np.random.default_rng(2)
    state = standing(env)
    state.qpos[:, 2:] += torch.tensor(0.1 * rng.normal(size=16), dtype=torch.float32)
    state.qvel[:] = torch.tensor(rng.normal(size=18), dtype=torch.float32)
    state.act[:] = torch.tensor(rng.uniform(size=26), dtype=torch.float32)
    action = torch.linspace(-1, 1, 26).expand(2, 26)
    obs = env.observe(state, action)[0]
    assert obs.shape == (env.obs_size,) == (166,)
    data = mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:], data.act[:] = (part[0].numpy() for part in state)
    mujoco.mj_forward(env.model, data)
    assert obs[0] == pytest.approx(state.qpos[0, 1].item() - env.stand_height, abs=1e-6)
    assert torch.equal(obs[1:5], state.qpos[0, 2:6])
    assert torch.equal(obs[11:23], state.qpos[0, 6:])
    assert torch.allclose(obs[23:35], 0.1 * state.qvel[0, 6:])
    assert torch.equal(obs[35:61], state.act[0])
    prm, ranges = env.model.actuator_gainprm, env.model.actuator_lengthrange
    optimum = (ranges[:, 1] - ranges[:, 0]) / (prm[:, 1] - prm[:, 0])
    lengths = prm[:, 0] + (data.actuator_length - ranges[:, 0]) / optimum
    np.testing.assert_allclose(obs[61:87].numpy(), lengths, atol=1e-5)
    np.testing.assert_allclose(obs[87:113].numpy(), data.actuator_velocity / (optimum * prm[:, 6]), atol=1e-5)
    np.testing.assert_allclose(obs[113:139].numpy(), -data.actuator_force / prm[:, 2], atol=1e-4)
    assert torch.equal(obs[139:165], action[0])
    assert obs[165] == 1.25


def test_muscle_curves_are_mujocos(env: MyoLeg26) -> None:
    prm, ranges = env.model.actuator_gainprm[0, :9], env.model.actuator_lengthrange[0]
    curves: MuscleCurves = env.curves
    optimum = (ranges[1] - ranges[0]) / (prm[1] - prm[0])
    for length in np.linspace(-0.2, 2.4, 27):
        for rate in (-1.5, -0.7, 0.0, 0.2, 0.6):
            path = ranges[0] + (length - prm[0]) * optimum
            gain = mujoco.mju_muscleGain(path, rate * optimum * prm[6], ranges, 1.0, prm)
            bias = mujoco.mju_muscleBias(path, ranges, 1.0, prm)
            at = torch.full((1, 26), float(length)), torch.full((1, 26), rate)
            found = curves.force(torch.full((1, 26), 0.3), *at)[0, 0].item()
            assert found == pytest.approx(-(0.3 * gain + bias) / prm[2], abs=2e-5)


def test_a_control_step_lasts_as_long_as_it_says(env: MyoLeg26) -> None:
    assert env.sim.timestep == pytest.approx(env.config.control_timestep)
    assert env.sim.substeps == 5


def test_a_fall_ends_the_episode(env: MyoLeg26) -> None:
    low = standing(env, pelvis_ty=0.6 * env.stand_height)
    leaning = standing(env, pelvis_list=1.2)
    assert env.fell(low).all()
    assert env.fell(leaning).all()
    assert not env.fell(standing(env)).any()


def test_success_is_standing_or_covering_the_distance() -> None:
    env = make(2, target_speed=1.25, episode_length=500)
    tail = {"upright": torch.ones(3, 2), "distance": torch.tensor([[7.0, 7.0], [7.5, 7.5], [7.9, 8.1]])}
    assert env.success(tail).tolist() == [False, True]
    still = make(2, target_speed=0.0)
    assert still.success({"upright": torch.tensor([[1.0, 1.0], [0.9, 0.1]])}).tolist() == [True, False]


def test_assistance_fades_and_the_score_is_free_of_it() -> None:
    helped = make(1, assist={"epochs": 10}, stochastic_reset=False)
    assert helped.model.nu == 32
    assert helped.action_size == 26
    state = standing(helped, pelvis_list=0.1)
    helped.state = helped.state._replace(physics=state)
    forces = []
    for epoch in (0, 5, 10, 11):
        helped.enter_epoch(epoch)
        forces.append(helped.control(torch.zeros(1, 26))[0, 26:])
    assert forces[0][4].item() == pytest.approx(-80.0, rel=1e-4)
    assert torch.allclose(forces[1], 0.5 * forces[0])
    assert not forces[2].any()
    assert not forces[3].any()
    reference = MyoLeg26.reference_settings(helped.config)
    assert reference.assist.epochs == 0


def test_springs_stay_while_the_legs_fall() -> None:
    config = AssistConfig(epochs=2, share=0.8, power=2.0, steady=4.0)
    springs = Assistance(config, 0.02, torch.device("cpu"))
    shares = []
    for epoch, length in enumerate((199.0, 200.0, 50.0, 500.0, 20.0)):
        springs.begin_epoch(epoch)
        assert springs.end_epoch(length) == {"train/assist": pytest.approx(springs.share.item())}
        shares.append(springs.share.item())
    assert shares == pytest.approx([0.8, 0.8, 0.2, 0.2, 0.0]), "0.8 (1 - k/2)², k counts episodes of 4 s and more"


def test_a_resumed_trial_has_the_springs_it_had() -> None:
    env, resumed = (make(1, assist={"epochs": 4, "steady": 4.0}) for _ in range(2))
    env.end_epoch(300.0)
    resumed.load_state_dict(env.state_dict())
    for each in (env, resumed):
        each.enter_epoch(1)
        assert each.end_epoch(0.0) == {"train/assist": 0.75}


def test_assistance_holds_the_trunk_and_does_not_ring() -> None:
    env = make(4, assist={"epochs": 10}, reset="mixed")
    env.enter_epoch(0)
    generator = torch.Generator().manual_seed(0)
    for _ in range(60):
        env.step((torch.rand((4, 26), generator=generator) - 0.5) * 1.6, auto_reset=False)
        qpos, qvel, _ = env.state.physics
        assert qvel[:, :6].abs().max() < 8.0
    assert qpos[:, 3:6].abs().median() < 0.2


def test_the_standing_keyframe_is_held_by_its_excitations(env: MyoLeg26) -> None:
    data = mujoco.MjData(env.model)
    mujoco.mj_resetDataKeyframe(env.model, data, env.model.key("stand").id)
    height, tilt = data.qpos[1], data.qpos[3]
    assert 0.0 <= data.ctrl.min() <= data.ctrl.max() < 0.3, "quiet standing takes little"
    while data.time < 0.3:
        mujoco.mj_step(env.model, data)
    assert data.qpos[1] == pytest.approx(height, abs=0.005)
    assert data.qpos[3] == pytest.approx(tilt, abs=0.03)


def test_scores_use_reference_weights_and_contacts_but_the_same_task() -> None:
    reward = LegReward(forward_vel=5.0, effort=0.0)
    trained = MyoLeg26Settings(name="myoleg26", reward=reward, target_speed=0.7, reset="walk")
    reference = MyoLeg26.reference_settings(trained)
    assert (reference.reward.forward_vel, reference.reward.effort) == (1.0, 0.2)
    assert (reference.target_speed, reference.reset) == (0.7, "walk")
    physics = MyoLeg26.reference_physics(PhysicsConfig(solref=(0.1, 1.0), substeps=4), None)
    assert physics == PhysicsConfig(substeps=4)


def test_bad_settings_are_named() -> None:
    with pytest.raises(ConfigError, match=r"env\.terrain\.slop: unknown key; did you mean 'slope'"):
        parse_config({"env": {"name": "myoleg26", "terrain": {"slop": 1}}})
