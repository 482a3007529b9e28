"""`evaluate --in mjlab`: every figure by hand with a stand-in for mjlab, and mjlab itself where installed."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tracked_motion import write_recorded_motion

from msk_ray.cli import run
from msk_ray.config import load_config
from msk_ray.envs import make_env
from msk_ray.errors import ConfigError
from msk_ray.evaluate.__main__ import main
from msk_ray.evaluate.stored import read_evaluations
from msk_ray.robots.mjlab.mjlab_side import with_future
from msk_ray.robots.mjlab.scoring import PLAY, MjlabScorer, mjlab_actions, motion_of, task_of
from msk_ray.robots.tracking.env import G1Tracking
from msk_ray.training import Trainer, load_policy

pytestmark = pytest.mark.long

INSTALL = "python -m venv .mjlab && .mjlab/bin/pip install mjlab==1.6.0"
# A step's reward is its number plus the seed. With pushes, world 0 falls in its third step and begins another episode.
STAND_IN = """
import types
import torch

print("mjlab prints a lot")

def load_env_cfg(task, play=False):
    assert task == "Mjlab-Velocity-Flat-Unitree-Go1"
    actor = types.SimpleNamespace(enable_corruption=not play)
    events = {} if play else {"push_robot": "push"}
    return types.SimpleNamespace(events=events, observations={"actor": actor}, scene=types.SimpleNamespace())

class Command:
    command = torch.tensor([[1.0, 0.0, 0.5]])
    def compute(self, dt):
        pass

class ManagerBasedRlEnv:
    step_dt = 0.02
    def __init__(self, cfg, device):
        self.worlds, self.seed, self.device = cfg.scene.num_envs, cfg.seed, device
        self.pushed = "push_robot" in cfg.events
        assert cfg.observations["actor"].enable_corruption == self.pushed
        data = types.SimpleNamespace(
            root_link_lin_vel_b=torch.tensor([[0.7, 0.4, 9.0]]).repeat(self.worlds, 1),
            root_link_ang_vel_b=torch.tensor([[9.0, 9.0, 0.25]]).repeat(self.worlds, 1),
        )
        self.scene = {"robot": types.SimpleNamespace(data=data)}
        self.command = Command()
        self.command_manager = types.SimpleNamespace(get_term=lambda name: self.command)
        self.action_manager = types.SimpleNamespace(total_action_dim=12)
        terms = {"upright": 25.0, "foot_slip": -5.0}
        step = torch.tensor(list(terms.values())).repeat(self.worlds, 1)
        self.reward_manager = types.SimpleNamespace(active_terms=list(terms), _step_reward=step)

    def reset(self):
        self.steps = 0
        return {"actor": torch.ones(self.worlds, 48)}, {}

    def step(self, action):
        assert action.shape == (self.worlds, 12) and abs(float(action[0, 0]) - EXPECTED) < 1e-6, action[0, 0]
        self.steps += 1
        self.command.compute(dt=0.02)
        fell = torch.zeros(self.worlds, dtype=torch.bool)
        fell[0] = self.pushed and self.steps == 3
        reward = torch.full((self.worlds,), float(self.steps + self.seed))
        return {"actor": torch.ones(self.worlds, 48)}, reward, fell, ~fell, {}
"""


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an untrained policy."""
    small = ("env.nworld=2", "shac.horizon=2", "actor.hidden=[8]", "actor.output_gain=1.0", "critic.hidden=[8]")
    config = load_config("go1_velocity", [*small, "env.action_range=3.0", "evaluation.nworld=1"])
    folder = tmp_path_factory.mktemp("go1") / "trial"
    trainer = Trainer(config, folder, "cpu")
    saved = trainer.save()
    trainer.close()
    (folder / "checkpoints").mkdir(exist_ok=True)
    saved.replace(folder / "checkpoints" / "best.pt")
    return folder


@pytest.fixture(scope="module")
def stand_in(trial: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment with a package that calls itself mjlab 1.6.0."""
    place = tmp_path_factory.mktemp("apart")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(place)], check=True)
    (site,) = place.glob("lib/python*/site-packages")
    (site / "ours.pth").write_text("\n".join(path for path in sys.path if path.endswith("-packages")))
    expected = 3.0 * float(load_policy(trial / "checkpoints" / "best.pt")(torch.ones(48))[0])
    assert abs(expected) > 1e-3
    for module in ("__init__", "envs", "tasks/__init__", "tasks/registry"):
        file = site / "mjlab" / f"{module}.py"
        file.parent.mkdir(exist_ok=True, parents=True)
        file.write_text("" if "__init__" in module else "from mjlab.all import ManagerBasedRlEnv, load_env_cfg\n")
    (site / "mjlab" / "all.py").write_text(STAND_IN.replace("EXPECTED", repr(expected)))
    _version(place, "1.6.0")
    return place / "bin" / "python"


def _version(place: Path, version: str) -> None:
    (site,) = place.glob("lib/python*/site-packages")
    (site / "mjlab.dist-info").mkdir(exist_ok=True)
    (site / "mjlab.dist-info" / "METADATA").write_text(f"Metadata-Version: 2.1\nName: mjlab\nVersion: {version}\n")


def entries(folder: Path) -> list[dict[str, Any]]:
    return read_evaluations(folder / "eval.json")


def test_figures_match_those_worked_out_by_hand(
    trial: Path, stand_in: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--in", "mjlab", "--python", str(stand_in), "--worlds", "2", "--seeds", "0,1", "--steps", "5"]
    assert run(main, [str(trial), *options]) == 0, capsys.readouterr()
    play, pushed = entries(trial)
    assert (play["physics"], pushed["physics"]) == ("mjlab play", "mjlab pushed")
    assert play["scores"] == [15.0] * 2 + [20.0] * 2
    assert play["length"] == {"mean": 5.0, "std": 0.0, "min": 5.0, "max": 5.0}
    assert play["terms"]["upright"]["mean"] == pytest.approx(25.0 * 0.02 * 5)
    assert play["terms"]["foot_slip"]["mean"] == pytest.approx(-5.0 * 0.02 * 5)
    assert play["outcomes"]["linear_error"]["mean"] == pytest.approx(0.5)
    assert play["outcomes"]["yaw_error"]["mean"] == pytest.approx(0.25)
    assert (play["fall_rate"], pushed["fall_rate"]) == (0.0, 0.5)
    assert pushed["scores"] == [6.0, 15.0, 9.0, 20.0]
    assert pushed["length"]["min"] == 3.0
    assert pushed["mjlab"]["mjlab"] == "1.6.0"
    assert not pushed["canonical"]
    printed = capsys.readouterr().out
    assert "mjlab pushed: 2 episodes with seed 1" in printed
    assert "under mjlab pushed physics: 2 worlds, seeds 0,1, 5 steps, on cpu" in printed


def test_what_mjlab_cannot_evaluate_is_refused_in_one_line(
    trial: Path, stand_in: Path, myoleg26_checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (trial / "eval.json").unlink(missing_ok=True)
    inside = ["--in", "mjlab"]
    cases = [
        ([str(trial), *inside, "--python", "gone"], f"no file gone; install mjlab beside msk_ray: {INSTALL}"),
        ([str(trial), *inside, "--python", sys.executable], "No module named 'mjlab'; install mjlab beside msk_ray"),
        ([str(myoleg26_checkpoint), *inside, "--python", str(stand_in)], "env myoleg26 is not a task of mjlab"),
    ]
    for arguments, why in cases:
        assert run(main, arguments) == 2, why
        said = capsys.readouterr().err.strip()
        assert why in said
        assert "\n" not in said
    place = stand_in.parents[1]
    _version(place, "2.0.0")
    try:
        assert run(main, [str(trial), *inside, "--python", str(stand_in)]) == 2
    finally:
        _version(place, "1.6.0")
    assert "mjlab 2.0.0 has other tasks than 1.6.x" in capsys.readouterr().err
    assert entries(trial) == []


def test_a_class_derived_from_a_robot_is_not_that_robot() -> None:
    config = load_config("go1_velocity")
    assert task_of(config) == "Mjlab-Velocity-Flat-Unitree-Go1"
    other = config.env.model_copy(update={"name": "my_robot:TallGo1"})
    with pytest.raises(ConfigError, match="env my_robot:TallGo1 is not a task of mjlab"):
        task_of(config.model_copy(update={"env": other}))


def test_a_policy_that_follows_a_clip_has_mjlabs_layout_and_actions() -> None:
    config = load_config("g1_tracking", ["env.action_range=2.0"])
    assert task_of(config) == "Mjlab-Tracking-Flat-Unitree-G1"
    other = load_config(
        "g1_tracking", ["env.layout=no_state_estimation", "env.action_about=default", "env.action_range=1.0"]
    )
    assert task_of(other) == "Mjlab-Tracking-Flat-Unitree-G1-No-State-Estimation"
    with pytest.raises(ConfigError, match=r"not with env.mirror"):
        task_of(load_config("g1_tracking", ["env.mirror=true"]))
    env = make_env(config.env, config.physics, 2, "cpu", 0, differentiable=False)
    assert isinstance(env, G1Tracking)
    obs, action = env.observation().numpy(), np.linspace(-1.0, 1.0, 58, dtype=np.float32).reshape(2, 29)
    expected = env.mjlab_action(torch.from_numpy(action)).numpy()
    np.testing.assert_allclose(mjlab_actions(config)(obs, action), expected, atol=1e-5)
    np.testing.assert_allclose(mjlab_actions(other)(obs, action), action)
    with motion_of(config) as motion:
        assert motion is not None
        with np.load(motion) as arrays:
            assert arrays["body_pos_w"].shape == (200, 30, 3)
    with motion_of(load_config("go1_velocity")) as motion:
        assert motion is None


def test_later_frames_are_seen_with_the_noise_of_the_present() -> None:
    command = SimpleNamespace(time_steps=torch.tensor([0, 8]))
    # In frame f, mjlab shows f and 10 f, then what is not of the reference.
    obs = torch.tensor([[0.5, 0.0, 7.0], [8.0, 79.0, 7.0]])
    seen = with_future(
        command, lambda: torch.stack((command.time_steps, 10 * command.time_steps), -1).float(), obs, [1, 3], 9
    )
    assert seen.tolist() == [[0.5, 0.0, 7.0, 1.5, 10.0, 3.5, 30.0], [8.0, 79.0, 7.0, 9.0, 89.0, 9.0, 89.0]]
    assert command.time_steps.tolist() == [0, 8]


def _own_python(root: Path) -> Path:
    python = root / ".mjlab" / "bin" / "python"
    if not python.is_file():
        pytest.skip(f"no mjlab beside msk_ray: {INSTALL}")
    return python


def test_a_policy_is_scored_in_the_real_mjlab(trial: Path, root: Path) -> None:
    python = _own_python(root)
    few = ["--worlds", "2", "--steps", "5"]
    assert run(main, [str(trial), "--in", "mjlab", "--python", str(python), *few]) == 0
    play, _ = (entry for entry in entries(trial) if entry["steps"] == 5 and entry["worlds"] == 2)
    assert play["scores"][0] != play["scores"][1]
    assert play["mjlab"]["mujoco"].startswith("3.11.")


def test_later_frames_are_the_same_in_the_real_mjlab(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    python = _own_python(root)
    few = ["env.nworld=2", "shac.horizon=2", "actor.hidden=[8]", "critic.hidden=[8]", "evaluation.nworld=1"]
    config = load_config("g1_tracking", [*few, "env.score_sampling=start", "env.stochastic_reset=false"])
    trainer = Trainer(config, tmp_path / "trial", "cpu")
    policy = load_policy(trainer.save())
    trainer.close()
    given: list[np.ndarray] = []
    act = type(policy).__call__
    monkeypatch.setattr(type(policy), "__call__", lambda self, obs: (given.append(obs), act(self, obs))[1])
    scorer = MjlabScorer(python)
    scorer.evaluate(policy, next(each for each in scorer.requests(1, None, 2) if each.physics == PLAY))
    # mjlab begins with the reference one frame further, and with noise in the joints: how the reference will move, in
    # the axes of its own torso, does not depend on where the robot is.
    start = config.env.model_copy(update={"sampling": "start", "future_frames": (1, 3, 6, 11, 21)})
    env = make_env(start, config.physics, 1, "cpu", 0, differentiable=False)
    ours, seen = env.observation()[0, 160:].view(5, 67), torch.from_numpy(given[0][0])
    seen = torch.cat((seen[:67], seen[160:])).view(5, 67)
    torch.testing.assert_close(seen[:, :58], ours[:, :58])
    for before, after in zip(_moved(seen), _moved(ours), strict=True):
        torch.testing.assert_close(before, after, atol=1e-5, rtol=0.0)
    assert (seen[1:, 60] < seen[0, 60] - 1e-4).all(), "a squat goes down"


def _moved(entries: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and orientations of the torso in entries (F, 67), in its axes in the first of them."""
    x, y = entries[:, 61:].view(-1, 3, 2).unbind(-1)
    turns = torch.stack((x, y, torch.linalg.cross(x, y)), dim=-1)
    return (entries[:, 58:61] - entries[0, 58:61]) @ turns[0], turns[0].T @ turns


@pytest.mark.slow
def test_recorded_fixtures_match_the_real_mjlab(root: Path, tmp_path: Path) -> None:
    python, fixtures = _own_python(root), root / "tests" / "fixtures" / "mjlab"
    subprocess.run([str(python), str(fixtures / "record.py"), str(tmp_path), str(tmp_path)], check=True)
    motion = tmp_path / "squat.npz"
    write_recorded_motion(motion)
    subprocess.run([str(python), str(fixtures / "record_tracking.py"), str(motion), str(tmp_path)], check=True)
    scenes = root / "msk_ray" / "robots" / "scenes"
    for file in scenes.glob("*.xml"):
        assert (tmp_path / file.name).read_text() == file.read_text()
    for file in fixtures.glob("*.npz"):
        recorded, now = np.load(file), np.load(tmp_path / file.name)
        assert recorded.files == now.files
        for name in recorded.files:
            if recorded[name].dtype.kind == "f":
                np.testing.assert_allclose(now[name], recorded[name], rtol=1e-3, atol=1e-3, err_msg=name)
            else:
                np.testing.assert_array_equal(now[name], recorded[name], err_msg=name)
