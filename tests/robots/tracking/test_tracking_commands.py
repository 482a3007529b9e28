"""`msk-ray motions` and `msk-ray track`."""

import csv
import json
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from msk_ray.cli import run
from msk_ray.config import load_config, parse_config
from msk_ray.diagnose.__main__ import main as diagnose
from msk_ray.errors import ConfigError, DeviceError
from msk_ray.export.__main__ import main as export
from msk_ray.robots.tracking import clip_scores, list_motions, track
from msk_ray.robots.tracking.clip_scores import ClipScore, follow_clips, totals
from msk_ray.training import Trainer, load_policy
from msk_ray.visualize import render


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two motions, the first a second long, and a file that is none."""
    motions = tmp_path / "motions"
    assert list_motions.main(["builtin:squat", "--strip", "none", "--npz", str(motions)]) == 0
    with np.load(motions / "squat.npz") as arrays:
        short = {name: array[:50] if name != "fps" else array for name, array in arrays.items()}
    np.savez(motions / "a.npz", **short)
    (motions / "none.csv").write_text("1,2,3\n1,2,3\n1,2,3\n")
    return motions


def test_motions_are_listed_checked_and_drawn(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_display() -> str:
        raise DeviceError("no OpenGL platform works without a display")

    monkeypatch.setattr(render, "headless_backend", no_display)
    capsys.readouterr()
    assert list_motions.main([str(folder), "--strip", str(tmp_path / "strip.png")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:4] for line in lines[2:4]] == [["a", "1.0", "50", "50"], ["squat", "4.0", "200", "50"]]
    assert lines[4] == "2 motions, 5 s (0.00 h)"
    assert lines[5].startswith(f"refused: {folder / 'none.csv'}: 3 numbers a frame, not 36")
    assert lines[6] == "nothing drawn: no OpenGL platform works without a display"


def test_a_motion_is_drawn_without_arrows_of_forces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    contacts = []

    def drawn(states: Any, view: Any) -> list[np.ndarray]:
        data = mujoco.MjData(states.model)
        data.qpos[:] = states.qpos[0]
        data.qpos[2] -= 0.05  # both feet in the ground
        mujoco.mj_forward(states.model, data)
        contacts.append(data.ncon)
        return [np.zeros((4, 4, 3), np.uint8) for _ in states.qpos]

    monkeypatch.setattr(render, "frames", drawn)
    assert list_motions.main(["builtin:squat", "--strip", str(tmp_path / "strip.png")]) == 0
    assert contacts == [0]


class Still:
    """Asks for the reference in every step."""

    def __init__(self, config: Any) -> None:
        self.config, self.path, self.epoch, self.env_steps = config, Path("still.pt"), 3, 9

    def on(self, env: Any) -> Any:
        return lambda obs: torch.zeros(len(obs), 29)


def test_follow_clips_scores_each_clip_once(folder: Path) -> None:
    (folder / "none.csv").unlink()
    env = {"name": "g1_tracking", "action_about": "reference", "motion": str(folder), "reward": {"tail": 1.0}}
    config = parse_config({"env": env, "algorithm": {"name": "shac"}})
    scores = follow_clips(Still(config), "cpu")  # type: ignore[arg-type]
    assert [score.clip for score in scores] == ["a", "squat"]
    short, whole = scores
    assert (short.seconds, short.failed, short.followed) == (1.0, False, 1.0)
    assert 0.5 < short.normalised_motion < 1.0
    assert short.normalised_return < short.normalised_motion
    assert 0.0 < short.r_mpkpe < short.mpkpe < 0.2
    if whole.failed:
        assert whole.followed < 1.0
        assert whole.normalised_motion < short.normalised_motion
    with pytest.raises(ConfigError, match=r"env cartpole follows no motions"):
        follow_clips(Still(parse_config({"env": {"name": "cartpole"}})), "cpu")  # type: ignore[arg-type]


def test_totals_are_means_over_clips_and_over_time() -> None:
    scores = [
        ClipScore("a", 10.0, False, 1.0, 0.9, 1.0, 0.02, 0.01),
        ClipScore("b", 30.0, True, 0.5, 0.3, 0.4, 0.06, 0.03),
    ]
    every = totals(scores)
    assert (every["clips"], every["failed"], every["seconds"]) == (2, 1, 40.0)
    assert every["normalised_return"] == pytest.approx(0.6)
    assert every["normalised_return_by_frame"] == pytest.approx((10.0 * 0.9 + 30.0 * 0.3) / 40.0)


def test_track_writes_a_row_for_each_clip(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = parse_config({"env": {"name": "g1_tracking", "layout": "no_state_estimation"}})
    checkpoint = tmp_path / "best.pt"
    checkpoint.write_bytes(b"")
    monkeypatch.setattr(track, "checkpoint_of", lambda target: checkpoint)
    monkeypatch.setattr(track, "find_target", lambda target, storage: None)
    monkeypatch.setattr("msk_ray.training.load_policy", lambda path: Still(config))
    score = ClipScore("a", 10.0, True, 0.4, 0.3, 0.35, 0.02, 0.01)
    monkeypatch.setattr(clip_scores, "follow_clips", lambda *given: [score])
    assert track.main([str(checkpoint), "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "a     10.0     failed  40%" in out
    assert "1 of 1 failed; return 0.300 (mean of the clips)" in out
    with (tmp_path / "clips.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["clip"], row["failed"], row["followed"]) == ("a", "True", "0.4")
    written = json.loads((tmp_path / "clips.json").read_text())
    assert (written["layout"], written["epoch"]) == ("no_state_estimation", 3)
    assert written["clips"][0]["normalised_return"] == 0.3
    assert written["motion"] == "builtin:squat"
    assert track.main([str(checkpoint), "--motion", "other"]) == 0
    assert capsys.readouterr().out.endswith("not written: add --out DIR\n")
    assert json.loads((tmp_path / "clips.json").read_text()) == written


@pytest.mark.parametrize(("config", "action_range"), [("g1_tracking", 4.0), ("g1_tracking_robust", 2.0)])
def test_an_exported_policy_follows_as_far_in_c_mujoco(
    config: str,
    action_range: float,
    tmp_path: Path,
    root: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    few = ("env.nworld=2", "shac.horizon=2", "shac.critic_batches=1", "evaluation.nworld=1")
    small = ("actor.hidden=[8]", "critic.hidden=[8]", f"env.action_range={action_range}")
    trainer = Trainer(load_config(config, [*few, *small]), tmp_path / "trial", "cpu")
    checkpoint = trainer.save()
    trainer.close()
    (score,) = follow_clips(load_policy(checkpoint), "cpu")
    assert run(export, [str(checkpoint), "--onnx", str(tmp_path / "squat.onnx")]) == 0
    assert list_motions.main(["builtin:squat", "--strip", "none", "--npz", str(tmp_path)]) == 0
    example = root / "docs" / "examples" / "run_tracking.py"
    assert "import msk_ray" not in example.read_text()
    words = [example.name, str(tmp_path / "squat.onnx"), str(tmp_path / "squat.npz")]
    monkeypatch.setattr(sys, "argv", words)
    capsys.readouterr()
    runpy.run_path(str(example), run_name="__main__")
    found = re.search(r"followed (\d+)%, motion ([\d.]+)", capsys.readouterr().out)
    assert found is not None
    assert float(found[1]) / 100.0 == pytest.approx(score.followed, abs=0.02)
    assert float(found[2]) == pytest.approx(score.normalised_motion, rel=0.02)


def test_gradients_along_a_motion_match_float64_differences(tmp_path: Path, root: Path) -> None:
    few = ["--states", "reset", "--horizons", "1", "3", "--worlds", "2", "--directions", "3"]
    assert diagnose([str(root / "configs" / "g1_tracking.yaml"), *few, "--output", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert len(rows) == 4
    for row in rows:
        assert row["cosine"] > 0.9999
        assert row["norm_ratio"] == pytest.approx(1.0, abs=1e-3)
