"""`evaluate --in myosuite`: every figure by hand with a stand-in for MyoSuite, and MyoSuite itself where installed."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from myosuite_model import walk_model

from msk_ray.cli import run
from msk_ray.config import PhysicsConfig, load_config
from msk_ray.envs import make_env
from msk_ray.envs.base import Env
from msk_ray.evaluate.__main__ import main
from msk_ray.evaluate.stored import read_evaluations
from msk_ray.legs.myosuite_walk.scoring import _acting
from msk_ray.training import Trainer, load_policy

pytestmark = pytest.mark.long

# Episodes without end (init), or of 3 steps that end with a fall (random). A step's reward is its number plus the seed.
STAND_IN = """
import types
import numpy as np

print("MyoSuite prints a lot")

class Env:
    def __init__(self, name, seed, reset_type):
        assert (name, reset_type in ("init", "random")) == ("myoLegWalk-v0", True)
        self.observation_space = types.SimpleNamespace(shape=(403,))
        self.action_space = types.SimpleNamespace(shape=(80,))
        self.unwrapped, self.dt = self, 0.01
        self.rwd_keys_wt = {"vel_reward": 5.0, "cyclic_hip": -10, "ref_rot": 10.0, "joint_angle_rew": 5.0, "done": -100}
        self.mj_data = types.SimpleNamespace(warning=[types.SimpleNamespace(number=0)] * 20)
        self.seed, self.random = seed, reset_type == "random"

    def reset(self):
        self.steps = 0
        return np.zeros(403, np.float32), {}

    def step(self, action):
        assert action.shape == (80,) and abs(float(action[0]) - EXPECTED) < 1e-6, action[0]
        self.steps += 1
        fell = self.random and self.steps == 3
        terms = {"vel_reward": self.steps, "cyclic_hip": 0.1, "ref_rot": 0.0, "joint_angle_rew": 0.0, "done": int(fell)}
        found = {"com_vel": np.array([0.0, 1.5]), "act": np.full(80, 0.5)}
        info = {"rwd_dict": terms, "obs_dict": found}
        return np.zeros(403, np.float32), self.steps + self.seed, fell, False, info

gym = types.SimpleNamespace(make=Env)
"""


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an untrained policy."""
    small = (f"env.model={walk_model()}", "env.nworld=2", "shac.horizon=2", "actor.hidden=[8]", "critic.hidden=[8]")
    config = load_config("myosuite_walk", [*small, "evaluation.nworld=1"])
    folder = tmp_path_factory.mktemp("walk") / "trial"
    trainer = Trainer(config, folder, "cpu")
    saved = trainer.save()
    trainer.close()
    (folder / "checkpoints").mkdir(exist_ok=True)
    saved.replace(folder / "checkpoints" / "best.pt")
    return folder


@pytest.fixture(scope="module")
def stand_in(trial: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment with a package that calls itself MyoSuite 2.12.2."""
    place = tmp_path_factory.mktemp("apart")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(place)], check=True)
    (site,) = place.glob("lib/python*/site-packages")
    (site / "ours.pth").write_text("\n".join(path for path in sys.path if path.endswith("-packages")))
    expected = float(load_policy(trial / "checkpoints" / "best.pt")(torch.zeros(403))[0])
    (site / "myosuite").mkdir()
    (site / "myosuite" / "__init__.py").touch()
    (site / "myosuite" / "utils.py").write_text(STAND_IN.replace("EXPECTED", repr(expected)))
    _version(place, "2.12.2")
    return place / "bin" / "python"


def _version(place: Path, version: str) -> None:
    (site,) = place.glob("lib/python*/site-packages")
    (site / "myosuite.dist-info").mkdir(exist_ok=True)
    (site / "myosuite.dist-info" / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: myosuite\nVersion: {version}\n"
    )


def entries(folder: Path) -> list[dict[str, Any]]:
    return read_evaluations(folder / "eval.json")


def test_every_figure_by_hand(trial: Path, stand_in: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--in", "myosuite", "--python", str(stand_in), "--worlds", "3", "--seeds", "0,1", "--steps", "5"]
    assert run(main, [str(trial), *options]) == 0, capsys.readouterr()
    own, random = entries(trial)
    assert (own["physics"], random["physics"]) == ("myosuite init", "myosuite random")
    assert own["scores"] == [15.0] * 3 + [20.0] * 3
    assert own["score_by_seed"] == {"0": 15.0, "1": 20.0}
    assert own["length"] == {"mean": 5.0, "std": 0.0, "min": 5.0, "max": 5.0}
    assert own["terms"]["vel_reward"]["mean"] == pytest.approx(5.0 * 15)
    assert own["terms"]["cyclic_hip"]["mean"] == pytest.approx(-10.0 * 0.1 * 5)
    assert (own["outcomes"]["vx"]["mean"], own["outcomes"]["activation"]["mean"]) == (1.5, 0.25)
    assert (own["fall_rate"], random["fall_rate"]) == (0.0, 1.0)
    assert random["scores"] == [6.0] * 3 + [9.0] * 3
    assert random["terms"]["done"]["mean"] == -100.0
    assert own["myosuite"]["myosuite"] == "2.12.2"
    assert not own["canonical"]
    assert "under myosuite random physics: 3 worlds, seeds 0,1, 5 steps, on cpu" in capsys.readouterr().out


def test_a_symmetric_policy_acts_there_as_in_training(trial: Path) -> None:
    found = load_policy(trial / "checkpoints" / "best.pt")
    config = load_config("myosuite_walk", [f"env.model={walk_model()}", "env.reset=random"])

    def make(symmetric: bool) -> Env[Any]:
        settings = config.env.model_copy(update={"symmetric": symmetric, "cycle": 1.0})
        return make_env(settings, PhysicsConfig(), 8, "cpu", 0, differentiable=False)

    plain, symmetric = make(False), make(True)

    class Policy:
        config = load_config("myosuite_walk", [f"env.model={walk_model()}", "env.symmetric=true"])

        def __call__(self, obs: Any) -> Any:
            return found(obs)

    act = _acting(Policy())  # type: ignore[arg-type]
    actions = torch.stack([torch.as_tensor(act(obs)) for obs in plain.observation().numpy()])
    there = symmetric.control(torch.as_tensor(found(symmetric.observation().numpy())))
    torch.testing.assert_close(plain.control(actions), there)
    exchanged = plain.observation()[:, 82] >= 0.5
    assert 0 < exchanged.sum() < 8
    assert (plain.control(torch.as_tensor(found(plain.observation().numpy()))) != there).any(-1).equal(exchanged)


def test_what_cannot_be_evaluated_there_is_one_line(
    trial: Path, stand_in: Path, myoleg26_checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (trial / "eval.json").unlink(missing_ok=True)
    inside = ["--in", "myosuite"]
    there = [*inside, "--python", str(stand_in)]
    cases = [
        ([str(trial), *inside, "--python", "gone"], "no file gone; install MyoSuite beside msk_ray: python -m venv"),
        ([str(trial), "--python", str(stand_in)], "--python: only --in reads it"),
        ([str(trial), *there, "--physics", "own"], "--physics: --in myosuite has its own physics"),
        ([str(trial), *there, "--steps", "1001"], "write at most 1000"),
        (
            [str(myoleg26_checkpoint), *there],
            "env myoleg26 is not a task of MyoSuite; train on env.name: myosuite_walk",
        ),
        (
            [str(trial), *inside, "--python", sys.executable],
            "No module named 'myosuite'; install MyoSuite beside msk_ray: python -m venv",
        ),
    ]
    for arguments, why in cases:
        assert run(main, arguments) == 2, why
        said = capsys.readouterr().err.strip()
        assert why in said
        assert "\n" not in said
    place = stand_in.parents[1]
    _version(place, "3.0.0")
    try:
        assert run(main, [str(trial), *there]) == 2
    finally:
        _version(place, "2.12.2")
    assert "MyoSuite 3.0.0 has other tasks than 2.12.x" in capsys.readouterr().err
    assert entries(trial) == []


def test_in_myosuite_itself(trial: Path, root: Path) -> None:
    python = root / ".myosuite" / "bin" / "python"
    if not python.is_file():
        pytest.skip(
            "no MyoSuite beside msk_ray: python -m venv .myosuite && .myosuite/bin/pip install myosuite==2.12.2"
        )
    few = ["--worlds", "2", "--steps", "5"]
    assert run(main, [str(trial), "--in", "myosuite", "--python", str(python), *few]) == 0
    own, random = (entry for entry in entries(trial) if entry["steps"] == 5 and entry["worlds"] == 2)
    assert own["scores"][0] == own["scores"][1]
    assert random["scores"][0] != random["scores"][1]
    assert own["myosuite"]["mujoco"].startswith("3.6.")
