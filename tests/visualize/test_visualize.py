"""Pictures without a display, for CartPole and the ant, on the CPU."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import av
import mujoco
import numpy as np
import pytest
from needs import need_drawing, slow
from PIL import Image

from msk_ray.cli import run
from msk_ray.config import PhysicsConfig
from msk_ray.envs.cartpole.config import CartPoleSettings
from msk_ray.envs.cartpole.env import CartPole
from msk_ray.errors import DeviceError
from msk_ray.evaluate.measure import Bench, Request
from msk_ray.experiment.manifest import Experiment
from msk_ray.report.__main__ import main as report
from msk_ray.training import load_policy
from msk_ray.visualize import render
from msk_ray.visualize.__main__ import main
from msk_ray.visualize.film import write_video
from msk_ray.visualize.look import ACTIVE, RELAXED, Look, describe_groups, geom_groups, muscle_tendons
from msk_ray.visualize.recording import record
from msk_ray.visualize.render import States, View, frames, headless_backend

pytestmark = pytest.mark.long

MUSCLE = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <light pos="0 -2 2" dir="0 1 -1"/>
    <camera name="front" pos="0 -1 0" xyaxes="1 0 0 0 0 1"/>
    <site name="a" pos="-.3 0 0"/>
    <body><joint type="slide" axis="1 0 0"/><geom size=".02"/><site name="b" pos=".3 0 0"/></body>
  </worldbody>
  <tendon><spatial name="t" width=".05"><site site="a"/><site site="b"/></spatial></tendon>
  <actuator><muscle name="m" tendon="t" lengthrange=".1 1"/></actuator>
</mujoco>
"""
RESTING = """
<mujoco>
  <worldbody>
    <light pos="0 -2 2" dir="0 1 -1"/>
    <camera name="front" pos="0 -2 .3" xyaxes="1 0 0 0 0 1"/>
    <geom type="plane" size="2 2 .1"/>
    <body pos="0 0 .048"><freejoint/><geom type="box" size=".05 .05 .05" mass="1"/></body>
  </worldbody>
</mujoco>
"""

SKY = """<asset><texture type="skybox" builtin="flat" rgb1="1 1 0" rgb2="1 1 0" width="8" height="48"/></asset>"""


@pytest.fixture
def drawing() -> str:
    """The OpenGL platform that works here."""
    return need_drawing()


@pytest.fixture(params=["cartpole", "myoleg26", *slow("ant")])
def target(request: pytest.FixtureRequest, sweep: Experiment) -> Path:
    """A trial's folder, or a checkpoint, of each environment."""
    if request.param == "cartpole":
        return sweep.trial_folder(sweep.trials()[0].id)
    path: Path = request.getfixturevalue("ant_trial" if request.param == "ant" else "myoleg26_checkpoint")
    return path


def decode(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_video_and_strip(target: Path, tmp_path: Path, drawing: str, capsys: pytest.CaptureFixture[str]) -> None:
    video, strip = tmp_path / "deep" / "out.mp4", tmp_path / "out.png"
    options = ["--steps", "20", "--size", "160x120", "--device", "cpu", "--fps", "30", "--frames", "3"]
    assert run(main, [str(target), "--video", str(video), "--strip", str(strip), *options]) == 0
    shots = decode(video)
    # 20 steps of 1/60 s, or 1/50 with muscles, fewer if it fell; at 30 frames a second with both ends.
    assert 2 <= len(shots) <= 13
    assert shots[0].shape == (120, 160, 3)
    assert np.ptp(shots[0]) > 50
    assert np.abs(shots[0].astype(int) - shots[-1].astype(int)).max() > 20, "something moved"
    with Image.open(strip) as image:
        assert image.size[0] == 3 * 160 + 2 * 4
        left, right = (np.asarray(image)[:120, x : x + 160] for x in (0, 328))
    assert np.ptp(left) > 50
    assert not np.array_equal(left, right)
    said = capsys.readouterr().out
    assert f"drawing {len(shots)} frames of 160x120 (fewer: --steps, --fps; smaller: --size) ..." in said
    assert f"{len(shots)} frames in {video}" in said


def test_a_gif_repeats_and_keeps_time(tmp_path: Path) -> None:
    frames = [np.full((16, 32, 3), level, np.uint8) for level in (0, 120, 240)]
    assert write_video(iter(frames), tmp_path / "a.gif", 20.0) == 3
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.size, image.info["loop"], image.info["duration"]) == (3, (32, 16), 0, 50)
        image.seek(2)
        assert np.abs(np.asarray(image.convert("RGB")).astype(int) - 240).max() <= 3, "in a colour of the last one"


def test_frames_and_progression(sweep: Experiment, tmp_path: Path, drawing: str) -> None:
    folder = Path(shutil.copytree(sweep.trial_folder(sweep.trials()[0].id), tmp_path / "trial"))
    small = ["--size", "64x48", "--device", "cpu", "--frames", "3"]
    assert run(main, [str(folder), "--save-frames", str(tmp_path / "f"), "--fps", "6", "--episodes", "2", *small]) == 0
    # Two episodes of 20 steps, a third of a second: frames at 0, 1/6 and 2/6 s.
    assert len(list((tmp_path / "f").glob("frame_*.png"))) == 6
    grid = tmp_path / "grid.png"
    assert run(main, ["--progression", str(folder), "--strip", str(grid), *small]) == 0
    with Image.open(grid) as image:
        # Four policies along the way and the best, each row of a title, frames, times and a gap.
        assert image.size == (3 * 64 + 2 * 4, 5 * (16 + 48 + 16 + 4) - 4)


def test_statistics_without_pictures(sweep: Experiment, capsys: pytest.CaptureFixture[str]) -> None:
    folder = sweep.trial_folder(sweep.trials()[0].id)
    assert run(main, [str(folder), "--no-render", "--episodes", "3", "--device", "cpu"]) == 0
    table = capsys.readouterr().out.splitlines()
    policy = load_policy(folder / "checkpoints" / "best.pt")
    scores = Bench("cpu").evaluate(policy, Request(worlds=3))["scores"]
    shown = [float(line.split()[1]) for line in table if line[:1].isdigit()]
    assert shown == [float(f"{score:.5g}") for score in scores]
    assert "mean ± std" in table[-1]


def test_a_recording_ends_where_its_episode_does(ant_trial: Path) -> None:
    recording = record(Bench("cpu"), load_policy(ant_trial / "checkpoints" / "best.pt"), Request(worlds=2, steps=12))
    assert recording.length(0) == 12
    assert len(recording.world(0)) == 13
    assert recording.ending(0) == "time"
    # At 30 a second, of 12 steps of 1/60 s: every second one.
    assert np.array_equal(recording.frames_at(0, 30.0).qpos, recording.world(0).qpos[::2])
    state = recording.world(1)
    assert (state.qvel.shape, state.act.shape, state.ctrl.shape) == ((13, 14), (13, 0), (13, 8))


def test_muscles_are_coloured_by_activation(drawing: str) -> None:
    model = mujoco.MjModel.from_xml_string(MUSCLE)
    assert muscle_tendons(model) == {0: [0]}
    Look(model).colour(np.array([0.25]))
    assert np.allclose(model.tendon_rgba[0, :3], 0.75 * RELAXED + 0.25 * ACTIVE, atol=1e-6)
    one = np.zeros((2, 1))
    states = States(model, one, one, np.array([[0.0], [1.0]]), one)
    relaxed, active = frames(states, View(96, 64))
    # In the middle of the picture runs the tendon: blue, then red.
    blue, red = relaxed[32, 30].astype(int), active[32, 30].astype(int)
    assert blue[2] > blue[0] + 30
    assert red[0] > red[2] + 30


def test_contact_forces_are_drawn(drawing: str) -> None:
    model = mujoco.MjModel.from_xml_string(RESTING)
    qpos = np.array([[0, 0, 0.048, 1, 0, 0, 0], [0, 0, 0.5, 1, 0, 0, 0]], dtype=float)
    states = States(model, qpos, np.zeros((2, 6)), np.zeros((2, 0)), np.zeros((2, 0)))
    resting, flying = (frame.astype(int) for frame in frames(states, View(160, 120)))
    arrows = [((f[..., 0] > f[..., 1] + 60) & (f[..., 2] > f[..., 1] + 20)).sum() for f in (resting, flying)]
    assert arrows[0] > 10
    assert arrows[1] == 0


def test_a_reference_is_drawn_pale_and_to_the_side(drawing: str) -> None:
    model = mujoco.MjModel.from_xml_string(RESTING)
    body = np.array([[0, 0, 0.048, 1, 0, 0, 0]], dtype=float)
    rest = np.zeros((1, 6)), np.zeros((1, 0)), np.zeros((1, 0))
    (alone,) = frames(States(model, body, *rest), View(160, 120))
    (both,) = frames(States(model, body, *rest, reference=body), View(160, 120))
    changed = (alone != both).any(-1)
    assert changed.any()
    assert not changed[60, 80], "the body itself stays"
    pale = both[changed].astype(int)
    assert (pale.max(-1) - pale.min(-1) < 60).mean() > 0.9


def test_models_without_sky_or_light_are_drawn_on_a_bright_day(drawing: str) -> None:
    dark = RESTING.replace('<light pos="0 -2 2" dir="0 1 -1"/>', "")
    body = np.array([[0, 0, 0.5, 1, 0, 0, 0]], dtype=float)
    shots = []
    for text in (dark, RESTING.replace("<worldbody>", SKY + "<worldbody>")):
        model = mujoco.MjModel.from_xml_string(text)
        (frame,) = frames(States(model, body, np.zeros((1, 6)), np.zeros((1, 0)), np.zeros((1, 0))), View(160, 120))
        shots.append(frame.astype(int))
    made, own = shots
    assert made[3, 3].min() > 200, "bright at the top"
    assert made[3, 3].sum() > made[50, 3].sum(), "and darker towards the horizon"
    assert own[3, 3, 0] > 200 > 50 > own[3, 3, 2], "a model's own sky stays"
    # The box in the middle is lit, although the model has no light.
    assert made[48, 80].min() > 90


def test_the_sun_follows_a_body_so_that_its_shadow_is_drawn() -> None:
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <light pos="1 0 4" dir="0 0 -1" type="directional"/>
      <light pos="2 0 4" dir="0 0 -1" type="spot"/>
      <body pos="0 0 1"><freejoint/><geom size="0.1"/></body>
    </worldbody></mujoco>""")
    Look(model)
    data = mujoco.MjData(model)
    data.qpos[0] = 50.0
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.light_xpos, [[51.0, 0.0, 4.0], [2.0, 0.0, 4.0]])


def test_a_robot_in_groups_that_are_not_drawn_is_shown(drawing: str) -> None:
    body = np.array([[0, 0, 0.3, 1, 0, 0, 0]], dtype=float)

    def shot(box_group: int, groups: tuple[int, ...] | None) -> np.ndarray:
        model = mujoco.MjModel.from_xml_string(RESTING.replace('type="box"', f'type="box" group="{box_group}"'))
        states = States(model, body, np.zeros((1, 6)), np.zeros((1, 0)), np.zeros((1, 0)))
        (frame,) = frames(states, View(96, 64, groups=groups))
        return frame

    visible, hidden = shot(0, None), shot(0, (1, 2))
    assert not np.array_equal(visible, hidden)
    assert np.array_equal(shot(5, None), visible)
    unseen = shot(5, (0,))
    assert np.array_equal(unseen, shot(5, (0, 1, 2)))
    assert not np.array_equal(unseen, visible)


def test_which_groups_are_drawn() -> None:
    def groups(*of_bodies: int) -> tuple[int, ...]:
        bodies = "".join(f'<body><freejoint/><geom size=".1" group="{group}"/></body>' for group in of_bodies)
        floor = '<geom type="plane" size="1 1 1"/>'
        return geom_groups(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{floor}{bodies}</worldbody></mujoco>"))

    assert groups() == groups(0) == groups(2, 3) == (0, 1, 2)
    assert groups(3) == (0, 1, 2, 3)
    assert groups(5, 3, 5) == (0, 1, 2, 3, 5)
    assert describe_groups(groups(2, 3)) == ""
    assert describe_groups(groups(5, 3)).startswith("geom groups 3, 5 drawn too: no moving body has a geom in")


def test_the_commands_say_which_groups_they_draw(
    sweep: Experiment,
    drawing: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    build = CartPole.build_model

    def hidden(config: CartPoleSettings, physics: PhysicsConfig) -> mujoco.MjModel:
        model = build(config, physics)
        model.geom_group[:] = 4
        return model

    monkeypatch.setattr(CartPole, "build_model", staticmethod(hidden))
    trial = sweep.trial_folder(sweep.trials()[0].id)
    words = [str(trial), "--strip", str(tmp_path / "s.png"), "--steps", "2", "--frames", "2", "--device", "cpu"]
    assert run(main, words) == 0
    assert "geom group 4 drawn too" in capsys.readouterr().out
    assert run(main, [*words, "--geom-groups", "4"]) == 0
    assert "drawn too" not in capsys.readouterr().out


def test_without_the_encoder_films_are_refused_and_everything_else_is_made(
    sweep: Experiment, drawing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(sweep.path, tmp_path / "runs" / "small"))
    monkeypatch.setitem(sys.modules, "av", None)
    trial = str(copy / "trials" / sweep.trials()[0].id)
    assert run(main, [trial, "--video", str(tmp_path / "a.mp4")]) == 2
    assert re.search("films need the package av .*: pip install av, or write a .gif\n$", capsys.readouterr().err)
    assert run(main, [trial, "--video", str(tmp_path / "a.gif"), "--steps", "3", "--size", "32x32"]) == 0
    assert run(report, [str(copy), "--device", "cpu"]) == 0
    assert (copy / "report" / "index.html").is_file()
    assert (copy / "report" / "strip.png").is_file()


@pytest.mark.slow
def test_a_report_does_not_load_the_encoder_on_its_way(sweep: Experiment, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(sweep.path, tmp_path / "runs" / "small"))
    code = (
        "import sys; sys.modules['av'] = None; from msk_ray.report.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )
    subprocess.run([sys.executable, "-c", code, str(copy), "--device", "cpu"], check=True)


def test_without_opengl_the_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    fault = render.probe("nonsense")  # a real process, which MuJoCo refuses to draw in
    assert fault is not None
    assert "nonsense" in fault
    monkeypatch.setattr(render, "probe", lambda backend: f"no {backend} here")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    headless_backend.cache_clear()
    try:
        with pytest.raises(DeviceError, match=r"egl: no egl here; osmesa: no osmesa here.*apt install libosmesa6"):
            headless_backend()
    finally:
        headless_backend.cache_clear()


def test_a_drawing_process_that_dies_is_reported(drawing: str) -> None:
    model = mujoco.MjModel.from_xml_string(RESTING)
    wrong = States(model, np.zeros((1, 3)), np.zeros((1, 6)), np.zeros((1, 0)), np.zeros((1, 0)))
    with pytest.raises(DeviceError, match="failed at frame 0: ValueError"):
        list(frames(wrong, View(32, 32)))
    with pytest.raises(DeviceError, match="--camera 'top': the model has front"):
        list(frames(wrong, View(32, 32, "top")))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "name one thing to draw"),
        (["small"], "say what to make: --video FILE"),
        (["small", "--no-render", "--video", "a.mp4"], "--no-render draws nothing"),
        (["small", "--video", "a.webm"], "ends in .mp4"),
        (["small", "--no-render", "--fps", "0"], "--fps 0: write a number above 0"),
        (["small", "--no-render", "--fps", "inf"], "--fps inf: write a number above 0, up to 1000"),
        (["small", "--no-render", "--seed", f"{10**20}"], f"seeds {10**20}: write whole numbers"),
        (["small", "--progression", "small"], "name one thing to draw"),
        (["smal", "--no-render"], "did you mean 'small'?"),
        (["small", "--no-render", "--geom-groups", "3"], "--geom-groups: --no-render draws nothing"),
    ],
)
def test_bad_input_is_one_line(
    sweep: Experiment,
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(main, [*arguments, "--storage", str(sweep.path.parent)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
