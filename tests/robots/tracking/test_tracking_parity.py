"""Observation, rewards, ends of episodes and metrics against those recorded from unmodified mjlab 1.6.0.

`tests/fixtures/mjlab/record_tracking.py` has recorded them, with the motion that `tracked_motion` writes.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from tracked_motion import CUT

from msk_ray.config import PhysicsConfig
from msk_ray.config.environments import settings_class
from msk_ray.envs import make_env
from msk_ray.envs.records import EnvState
from msk_ray.robots.tracking.env import G1Tracking
from msk_ray.step import StepState

RECORDED = Path(__file__).parents[2] / "fixtures" / "mjlab" / "g1_tracking_steps.npz"


def make(count: int, **changes: object) -> G1Tracking:
    settings = settings_class("g1_tracking")(name="g1_tracking", cut=CUT, **changes)
    env = make_env(settings, PhysicsConfig(), count, "cpu", 0, differentiable=False)
    assert isinstance(env, G1Tracking)
    return env


class Recorded:
    """The recorded steps, and an environment with a world for each, in the state that it began with."""

    def __init__(self) -> None:
        with np.load(RECORDED) as arrays:
            self.names = list(arrays["term_names"])
            self.weights = dict(zip(self.names, arrays["term_weights"].tolist(), strict=True))
            self.action_scale, self.soft_limits = arrays["action_scale"], arrays["soft_limits"]
            self.steps = {
                name: torch.from_numpy(arrays[name].reshape(-1, *arrays[name].shape[2:]))
                for name in arrays.files
                if arrays[name].ndim > 1 and name != "soft_limits"
            }
        count = len(self["reward"])
        self.env = make(count)
        env = self.env
        self.kept = ~self["terminated"]
        began = StepState(self["began_qpos"], self["began_qvel"], env.state.physics.act)
        first = self["began_frame"].float()
        numbers = torch.stack((first, torch.full_like(first, env.references.lengths[0] - 1)), dim=-1)
        state = EnvState(began, self["began_previous_action"], torch.zeros_like(env.state.age), numbers)
        env.state = state._replace(memory={"action": self["began_previous_action"], "anchor": torch.zeros(count, 14)})
        anchor = env.anchor_pose(began).repeat(1, 2)
        env.state = env.state._replace(memory={"action": self["began_previous_action"], "anchor": anchor})

    def __getitem__(self, name: str) -> Tensor:
        return self.steps[name]


@pytest.fixture
def recorded() -> Recorded:
    return Recorded()


def close(ours: Tensor, theirs: Tensor, **more: object) -> None:
    torch.testing.assert_close(ours, theirs, atol=1e-3, rtol=1e-5, **more)  # type: ignore[arg-type]


def test_actions_and_observations_are_mjlabs(recorded: Recorded) -> None:
    env = recorded.env
    np.testing.assert_allclose(env.action_scale, recorded.action_scale, rtol=1e-5)
    np.testing.assert_allclose(torch.stack(env.joint_limits, -1), recorded.soft_limits, atol=1e-5)
    close(env.observation(), recorded["began_obs"])
    layout = env.observation_layout()
    assert len(layout) == env.obs_size == recorded["obs"].shape[1]
    # mjlab's critic sees the bodies before the velocities.
    theirs = recorded["began_critic_obs"]
    bodies = 9 * len(env.bodies)
    shown = 2 * env.action_size + 9
    close(
        env.critic_observation(),
        torch.cat((theirs[:, :shown], theirs[:, shown + bodies :], theirs[:, shown : shown + bodies]), -1),
    )


def test_the_layout_without_state_estimation_lacks_what_a_robot_cannot_measure(recorded: Recorded) -> None:
    env = make(1, layout="no_state_estimation")
    names = [entry.name for entry in recorded.env.observation_layout()]
    kept = [not name.startswith(("anchor_position", "imu_velocity")) for name in names]
    assert [entry.name for entry in env.observation_layout()] == [
        n for n, keep in zip(names, kept, strict=True) if keep
    ]
    assert env.obs_size == len(names) - 6
    assert env.critic_size == recorded.env.critic_size


def test_each_term_is_mjlabs(recorded: Recorded) -> None:
    env, kept, terms = recorded.env, recorded.kept, recorded["terms"]
    assert {term.name for term in env.active_terms} == set(recorded.names)
    env.next_memory = {"action": recorded["action"]}
    measured = StepState(recorded["measured_qpos"], recorded["measured_qvel"], env.state.physics.act)
    end = StepState(recorded["qpos"], recorded["qvel"], env.state.physics.act)
    for term in env.active_terms:
        assert term.weight_in(env.config.reward) == pytest.approx(recorded.weights[term.name]), term.name
        if term.name == "self_collisions":
            continue
        state = end if term.name == "joint_limit" else measured
        ours = term.measure(env, state, recorded["action"], recorded["obs"])
        theirs = terms[:, recorded.names.index(term.name)]
        close(ours[kept], theirs[kept], msg=lambda m, name=term.name: f"{name} {m}")
        assert theirs[kept].std() > 1e-3, f"{term.name} is the same in all recorded steps"
    assert torch.equal(env.fell(measured), recorded["terminated"])
    assert recorded["terminated"].any()


def test_a_step_is_mjlabs(recorded: Recorded) -> None:
    """From the recorded states, with this package's physics, which lets the solver converge."""
    env = recorded.env
    found = env.step(recorded["action"], auto_reset=False)
    # mjlab looks at bodies 5 ms earlier.
    assert (found.terminated != recorded["terminated"]).sum() <= 2
    kept = recorded.kept & ~found.terminated
    close(found.obs[kept], recorded["obs"][kept])
    outcome = env.outcome_terms(env.state.physics)
    for name in ("mpkpe", "r_mpkpe"):
        close(outcome[name][kept], recorded[name][kept])
    ours = (found.terms / env.weighted_terms.weights)[kept]
    for k, term in enumerate(env.active_terms):
        theirs = recorded["terms"][kept, recorded.names.index(term.name)]
        if term.name in ("joint_limit", "action_rate_l2"):
            close(ours[:, k], theirs, msg=lambda m, name=term.name: f"{name} {m}")
        elif term.name == "self_collisions":
            # mjlab sees one contact of a substep, whichever comes first; this the strongest.
            assert (ours[:, k].round() >= theirs.round()).all()
            assert (ours[:, k].round() == theirs.round()).float().mean() > 0.9
