"""From states to series: forces, angles and power of the 26-muscle model; and the command."""

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from PIL import Image

from msk_ray.config import Config, PhysicsConfig, parse_config
from msk_ray.envs import make_env
from msk_ray.errors import ConfigError
from msk_ray.evaluate.__main__ import main as evaluate
from msk_ray.legs.gait.__main__ import main
from msk_ray.legs.gait.body import analyse
from msk_ray.legs.gait.measure import measure
from msk_ray.legs.gait.people import curve
from msk_ray.legs.gait.stick import figures, film, one_stride
from msk_ray.legs.myoleg26.config import MyoLeg26Settings
from msk_ray.legs.myoleg26.model import build_myoleg26
from msk_ray.training import Trainer


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_myoleg26(MyoLeg26Settings(name="myoleg26"), PhysicsConfig())


def test_series_of_quiet_standing(model: mujoco.MjModel) -> None:
    key, data = model.key("stand"), mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, key.id)
    for _ in range(60):
        mujoco.mj_step(model, data)
    episode = analyse(model, data.qpos[None], data.qvel[None], data.act[None], 0.02)
    weight = 9.81 * model.body_subtreemass[0]
    assert episode.weight == pytest.approx(weight)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    # Newton: what the ground gives is the weight and what the centre of mass accelerates with.
    acceleration = np.zeros(3)
    for body in range(1, model.nbody):
        out = np.zeros(6)
        mujoco.mj_rnePostConstraint(model, data)
        mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_BODY, body, out, 0)
        # mj_objectAcceleration gives the body's centre of mass and counts gravity as upward acceleration.
        acceleration += model.body_mass[body] * out[3:]
    total = sum(episode.curves["vertical_force"][side][0] for side in "rl")
    assert total == pytest.approx(acceleration[2] / weight, rel=1e-3)
    assert 0.7 < total < 1.3
    assert episode.curves["vertical_force"]["r"][0] == pytest.approx(episode.curves["vertical_force"]["l"][0], rel=1e-3)
    assert episode.curves["knee_flexion"]["r"][0] == pytest.approx(-np.rad2deg(data.qpos[9]))
    assert episode.curves["hip_flexion"]["l"][0] == pytest.approx(np.rad2deg(data.qpos[12]))


def test_a_leading_foot_is_ahead(model: mujoco.MjModel) -> None:
    key = model.key("walk_right")
    episode = analyse(model, key.qpos[None], key.qvel[None], key.act[None], 0.02)
    assert episode.feet["r"][0] - episode.feet["l"][0] > 0.4


def test_a_model_without_legs_is_refused() -> None:
    other = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(ConfigError, match="gait needs a model of two legs"):
        analyse(other, np.zeros((1, 7)), np.zeros((1, 6)), np.zeros((1, 0)), 0.02)


@pytest.mark.long
def test_the_command_writes_json_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = parse_config(
        {
            "env": {"name": "myoleg26", "nworld": 4, "target_speed": 0.0, "gait_worlds": 2},
            "shac": {"horizon": 2, "critic_iterations": 1, "critic_batches": 1},
            "actor": {"hidden": [8]},
            "critic": {"hidden": [8]},
            "evaluation": {"nworld": 2, "steps": 5, "interval": 1},
            "trial": {"epochs": 1},
        }
    )
    fewer = config.model_copy(update={"evaluation": config.evaluation.model_copy(update={"nworld": 1})})
    with pytest.raises(ConfigError, match=r"keeps 2 worlds of every evaluation.*evaluation.nworld of 2 or more"):
        Trainer(fewer, tmp_path / "refused", "cpu")
    trainer = Trainer(config, tmp_path / "trial", "cpu")
    row = trainer.run_epoch()
    trainer.close()
    assert row["eval/gait_distance"] == 10.0, "nobody walks in five steps"
    assert main([str(tmp_path / "trial"), "--worlds", "2", "--steps", "80", "--device", "cpu"]) == 0
    gait = json.loads((tmp_path / "trial" / "gait.json").read_text())
    assert gait["episodes"] == 2
    assert set(gait["measures"]) >= {"speed", "cadence", "step_length", "duty_factor"}
    assert (tmp_path / "trial" / "gait.png").stat().st_size > 10_000
    assert "of which ended in a fall" in capsys.readouterr().out
    (entry,) = json.loads((tmp_path / "trial" / "eval.json").read_text())["evaluations"]
    assert entry["gait"]["gait_distance"] == gait["gait_distance"]
    assert "curves" not in entry["gait"]
    more = [str(tmp_path / "trial"), "--worlds", "1", "--steps", "5", "--device", "cpu", "--speeds", "0.5,1.25"]
    assert main(more) == 0
    assert (tmp_path / "trial" / "gait_0.5.json").is_file()
    assert (tmp_path / "trial" / "speeds.png").stat().st_size > 10_000
    assert len([line for line in capsys.readouterr().out.splitlines() if "best.pt_" in line]) == 2
    shorter = ["--worlds", "2", "--steps", "10", "--device", "cpu"]
    assert evaluate([str(tmp_path / "trial"), *shorter, "--with", "push,weak"]) == 0
    told = capsys.readouterr().out
    assert all(f"own, {name}" in told for name in ("push", "weak"))
    stored = json.loads((tmp_path / "trial" / "eval.json").read_text())["evaluations"]
    assert {entry["physics"] for entry in stored} == {"own", "own, push", "own, weak"}
    with pytest.raises(ConfigError, match=r"--with ice: a trial .* has push, weak, uphill, downhill, rough; write"):
        evaluate([str(tmp_path / "trial"), *shorter, "--with", "ice"])
    with pytest.raises(ConfigError, match="write positive numbers"):
        main([str(tmp_path / "trial"), "--speeds", "0.5,-1"])


@pytest.mark.long
def test_people_on_the_legs_of_the_model_are_close_to_people(model: mujoco.MjModel, tmp_path: Path) -> None:
    """The measured angles, played back by the clock with the measured force, come back as they were measured."""
    env = make_env(
        MyoLeg26Settings(name="myoleg26", clock=True, reset="cycle", stochastic_reset=False),
        PhysicsConfig(), 1, "cpu", 0, differentiable=False,
    )  # fmt: skip
    time = 0.02 * torch.arange(250)
    phase = time * env.reference.pace.strides_per_second(torch.tensor([1.25]))
    states = env.draw_phase(phase % 1.0, torch.full_like(phase, 1.25))
    states.qpos[:, 0] = 1.25 * time
    episode = analyse(model, *(part.double().numpy() for part in states), 0.02)
    for side, ahead in (("r", 0.0), ("l", 0.5)):
        at = 100.0 * np.remainder(phase.numpy() + ahead, 1.0)
        episode.curves["vertical_force"][side] = np.interp(at, np.arange(101), curve("vertical_force").mean)
    found = measure([episode], [False])
    assert found["gait_distance"] < 0.7
    for name in ("hip_flexion", "knee_flexion", "ankle_dorsiflexion"):
        assert found["people"][name]["within_centred"] == 1.0
        assert found["people"][name]["correlation"] > 0.98
    assert found["measures"]["cadence"]["value"] == pytest.approx(116.8, abs=1.5)
    # One of these strides as stick figures is one of people's.
    stride, seconds = one_stride([episode], [states.qpos.double().numpy()])
    assert seconds == pytest.approx(120.0 / 116.8, abs=0.02)
    own, people = figures(model, stride), figures(model, env.people_poses())
    assert own.shape == (len(stride), 3, 5, 2)
    for k in (0, 12, 25, 40):
        assert np.abs(own[k] - people[round(2.0 * k / seconds) % 100]).max() < 0.05
    right, left, trunk = own[0]
    assert right[3, 0] - left[3, 0] == pytest.approx(0.64, abs=0.03), "the right heel is ahead"
    assert trunk[1, 1] - trunk[0, 1] == pytest.approx(0.5, abs=0.01)
    assert film(own, people, seconds, tmp_path / "stride.gif") == 30
    with Image.open(tmp_path / "stride.gif") as picture:
        assert picture.n_frames > 20
    with pytest.raises(ConfigError, match="takes no stride to draw"):
        one_stride([replace(episode, curves={"vertical_force": {"r": np.ones(250)}})], [stride])


def test_another_environment_is_refused(tmp_path: Path, tiny_cartpole: Config) -> None:
    trainer = Trainer(
        tiny_cartpole.model_copy(update={"trial": tiny_cartpole.trial.model_copy(update={"epochs": 1})}),
        tmp_path / "t",
        "cpu",
    )
    trainer.run_epoch()
    trainer.close()
    with pytest.raises(ConfigError, match="gait needs a model of two legs"):
        main([str(tmp_path / "t"), "--device", "cpu"])


def test_nothing_is_written_beside_the_policies_of_the_package() -> None:
    with pytest.raises(ConfigError, match=r"cartpole\.pt belongs to the package, .* add --out DIR"):
        main(["cartpole"])
