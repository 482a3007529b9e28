"""What commands that simulate say and check before they load torch and Warp."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from msk_ray import progress
from msk_ray.__main__ import commands
from msk_ray.cli import run
from msk_ray.diagnose.__main__ import main as diagnose
from msk_ray.evaluate.__main__ import main as evaluate
from msk_ray.experiment.manifest import Experiment
from msk_ray.gradcheck import main as gradcheck
from msk_ray.progress import KernelCount, Pace, ProgressLine
from msk_ray.visualize.__main__ import main as visualize

COMMANDS = ("list", "gradcheck", "diagnose", "evaluate", "play", "visualize", "gait")
PGS = """<mujoco><option solver="PGS"/><worldbody><body><joint/><geom size=".1"/></body></worldbody></mujoco>"""


def test_they_speak_before_torch_is_loaded() -> None:
    """Which takes seconds."""
    modules = ", ".join(commands()[name].module for name in COMMANDS)
    code = f"import sys, {modules}; print([name for name in ('torch', 'warp', 'mujoco_warp') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


def test_progress_needs_no_more_of_a_row_than_every_algorithm_has(capsys: pytest.CaptureFixture[str]) -> None:
    ProgressLine(1).show({"epoch": 1, "env_steps": 8, "seconds": 0.1, "env_steps_per_s": 1234.5})
    assert capsys.readouterr().out == "epoch 1/1  1,234 env steps/s\n"


def test_the_time_left_is_told_without_the_compilation(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """42 s for the first epoch, of which 40 are compilation, and then 2 s each."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    line = ProgressLine(40)
    for epoch in range(1, 8):
        now[0] = 40.0 + 2.0 * epoch
        line.show({"epoch": epoch, "env_steps_per_s": 1.0})
    assert capsys.readouterr().out.splitlines() == [
        "epoch 1/40  1 env steps/s",
        "epoch 6/40  1 env steps/s  1m08s left",
    ]


def test_progress_says_that_epochs_could_be_faster(capsys: pytest.CaptureFixture[str]) -> None:
    row = {"epoch": 1, "env_steps": 8, "seconds": 0.1, "env_steps_per_s": 1234.5, "train/unrecordable": 1.0}
    ProgressLine(1).show(row)
    line = capsys.readouterr().out
    assert line == "epoch 1/1  1,234 env steps/s  not recorded: two to three times as slow\n"


@pytest.mark.long
def test_warp_starts_without_a_word_where_there_is_no_gpu() -> None:
    if Path("/dev/nvidiactl").exists():
        pytest.skip("there is a GPU")
    code = "import msk_ray.step.forward, warp; print(warp.get_devices())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.stderr, done.stdout.strip()) == ("", "['cpu']")


def test_what_they_do_is_their_first_line(
    sweep: Experiment, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = shutil.copytree(sweep.trial_folder(sweep.trials()[0].id), tmp_path / "trial")
    best = trial / "checkpoints" / "best.pt"
    cartpole = str(root / "configs" / "cartpole.yaml")
    tiny = ["--states", "reset", "--horizons", "1", "--worlds", "2", "--directions", "2", "--output", str(tmp_path)]
    for main, arguments, words in (
        (gradcheck, [cartpole, "--worlds", "2", "--states", "random"], "on cpu: 2 states each of random, 1 substep(s)"),
        (diagnose, [cartpole, *tiny], "2 worlds of each kind of state, horizons 1, 2 directions"),
        (evaluate, [str(trial), "--worlds", "2", "--steps", "3", "--device", "cpu"], f"evaluating {best}"),
        (
            visualize,
            [str(trial), "--no-render", "--steps", "3", "--device", "cpu"],
            f"running 10 episodes at once of {best}",
        ),
    ):
        assert run(main, arguments) in (0, 1)
        first = capsys.readouterr().out.splitlines()[0]
        assert words in first
        assert "kernels that are not in Warp's cache are compiled first" in first


@pytest.mark.parametrize(
    ("main", "arguments", "message"),
    [
        (gradcheck, ["none.xml"], "no model file none.xml"),
        (gradcheck, ["pgs.xml"], 'write solver="Newton", or "CG"'),
        (diagnose, ["none.pt"], "no checkpoint none.pt"),
        (diagnose, ["none.pt", "--seed", "-1"], "--seed must not be negative"),
        (evaluate, ["TRIAL", "--physics", "reference,moon"], "write one of reference, own"),
        (visualize, ["TRIAL", "--strip", "a.doc"], "write a name that ends in .png"),
        (visualize, ["TRIAL", "--strip", "a.png", "--camera", "moon"], "--camera 'moon': the model has"),
    ],
)
def test_they_refuse_before_they_simulate(
    main: Callable[[Sequence[str] | None], int],
    arguments: list[str],
    message: str,
    sweep: Experiment,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from msk_ray.training.evaluation import Evaluator

    monkeypatch.setattr(Evaluator, "episodes", lambda *_, **__: pytest.fail("it was not checked before"))
    monkeypatch.setattr("msk_ray.visualize.render.headless_backend", lambda: "osmesa")
    monkeypatch.chdir(tmp_path)
    Path("pgs.xml").write_text(PGS)
    trial = str(sweep.trial_folder(sweep.trials()[0].id))
    assert run(main, [trial if word == "TRIAL" else word for word in arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_the_time_left_is_told_after_two_seconds_and_then_every_ten(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    pace = Pace("states", 100)
    for second in range(1, 14):
        now[0] = float(second)
        pace(second)
    pace(100)
    # A state a second: 98 and 88 are left.
    assert capsys.readouterr().out.splitlines() == [
        "  2 of 100 states, about 1m38s left",
        "  12 of 100 states, about 1m28s left",
    ]


def test_kernels_are_counted_after_two_seconds_then_every_ten_and_at_the_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    count = KernelCount()
    for second in range(16):
        now[0] = float(second)
        count(second, 15)
    for done in (15, 16):  # quick: nothing to say
        count(done, 16)
    assert capsys.readouterr().out.splitlines() == [
        "kernels 2 of 15, 2s",
        "kernels 12 of 15, 12s",
        "kernels 15 of 15, 15s",
    ]
