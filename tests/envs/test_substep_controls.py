"""Controls that arrive within a step: the last state and its gradients against C MuJoCo, contacts of every substep."""

from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from msk_ray.config import PhysicsConfig, parse_config
from msk_ray.envs import Env, make_env
from msk_ray.envs.substep_controls import SubstepControls
from msk_ray.errors import ConfigError
from msk_ray.step import Simulation
from msk_ray.step.autograd.contact_state import ContactQueries
from msk_ray.step.autograd.kinematics import Kinematics

W, STEPS, S = 3, 4, 4


def late_cartpole(whole: int, part: int) -> Env[Any]:
    config = parse_config({"env": {"name": "cartpole"}})
    delays = {"control_delay": [whole, whole], "control_delay_substeps": [part, part]}
    return make_env(config.env, PhysicsConfig.model_validate({"randomize": delays}), W, "cpu", 0, randomize=True)


def in_c(model: mujoco.MjModel, values: NDArray[np.float64], delay: int) -> NDArray[np.float64]:
    """qpos and qvel after all substeps, for those before the first and then a control for each env step, where each
    control arrives `delay` substeps late; until then, the first one acts."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = values[:2], values[2:4]
    for substep in range(STEPS * S):
        data.ctrl[0] = values[4 + max(0, (substep - delay) // S)]
        mujoco.mj_step(model, data)
    return np.concatenate((data.qpos, data.qvel))


@pytest.mark.parametrize(("whole", "part"), [(0, 1), (1, 3)])
def test_states_and_gradients_are_those_of_late_controls_in_c_mujoco(whole: int, part: int) -> None:
    env = late_cartpole(whole, part)
    assert env.sim.substeps == S
    rng = np.random.default_rng(part)
    actions = [torch.tensor(rng.uniform(-0.9, 0.9, (W, 1)), dtype=torch.float32) for _ in range(STEPS)]
    start = [values.clone().requires_grad_() for values in env.state.physics[:2]]
    for action in actions:
        action.requires_grad_()
    env.state = env.state._replace(physics=env.state.physics._replace(qpos=start[0], qvel=start[1]))
    for action in actions:
        env.step(action)
    end = torch.cat(env.state.physics[:2], dim=-1)
    weights = rng.normal(size=(W, 4))
    loss = (end * torch.tensor(weights, dtype=torch.float32)).sum()
    gradients = torch.autograd.grad(loss, [*start, *actions], materialize_grads=True)
    ours = torch.cat(gradients, dim=-1).numpy()
    values = torch.cat([*start, *actions], dim=-1).detach().double().numpy()
    delay, eps = whole * S + part, 1e-6
    for world in range(W):
        expected = in_c(env.model, values[world], delay)
        np.testing.assert_allclose(end[world].detach().numpy(), expected, atol=1e-4)
        slopes = [
            weights[world]
            @ (in_c(env.model, values[world] + shift, delay) - in_c(env.model, values[world] - shift, delay))
            / (2.0 * eps)
            for shift in eps * np.eye(values.shape[1])
        ]
        np.testing.assert_allclose(ours[world], slopes, rtol=1e-3, atol=1e-4)
    sent_in_time = STEPS - whole - (part > 0)
    assert (np.abs(ours[:, 4 : 4 + sent_in_time]) > 1e-3).all()


def test_delays_are_drawn_among_all_from_the_fewest_to_the_most() -> None:
    config = parse_config({"env": {"name": "cartpole"}})
    physics = PhysicsConfig.model_validate({"randomize": {"control_delay_substeps": [1, 3]}})
    env = make_env(config.env, physics, 64, "cpu", 0, randomize=True)
    env.step(torch.zeros(64, 1))
    late = (env.disturbances.control(torch.ones(64, 1), env.state) == 0.0).sum(0)
    assert set(late[:, 0].tolist()) == {1, 2, 3}


BALL = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 0.101"><joint name="z" type="slide" axis="0 0 1"/><geom name="ball" size="0.1"/></body>
  </worldbody>
  <actuator><motor joint="z"/></actuator>
</mujoco>"""


def test_with_one_control_it_is_the_plain_simulation_with_its_contacts() -> None:
    model = mujoco.MjModel.from_xml_string(BALL)
    ends = []
    for kind in (Simulation, SubstepControls):
        sim = kind(model, 2, 8, None, "cpu")
        query = ContactQueries(Kinematics(sim.batch))("ball")
        sim.measure_contacts(query)
        ctrl = torch.tensor([[0.0], [-30.0]])
        end = sim.step(ctrl if kind is Simulation else ctrl.expand(8, 2, 1), *sim.initial_state())
        ends.append((end, sim.contacts(query)))
    (plain, contact), (apart, contact_apart) = ends
    torch.testing.assert_close(apart, plain, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(contact_apart, contact, rtol=1e-3, atol=1e-3)
    assert contact.touching.shape == (8, 2, 1)
    assert not contact.touching[0].any()
    assert contact.touching[:, 1].any()
    with pytest.raises(ConfigError, match="one control for each substep"):
        sim.step(ctrl, *sim.initial_state())


def test_what_does_not_go_together_is_refused() -> None:
    with pytest.raises(ConfigError, match="an env step has 4 substeps, so write at most 3"):
        late_cartpole(0, 4)
    late = {"substep_grad_clip": 1.0, "randomize": {"control_delay_substeps": [0, 1]}}
    with pytest.raises(ValueError, match=r"substep_grad_clip does not act with randomize\.control"):
        PhysicsConfig.model_validate(late)
