"""Mistakes on the command line and in files: each ends with one line that names what to write, and changes nothing."""

import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from msk_ray import __main__ as any_command
from msk_ray import gradcheck, status, train
from msk_ray.cli import run
from msk_ray.config import packages
from msk_ray.dashboard import __main__ as dashboard
from msk_ray.diagnose import __main__ as diagnose
from msk_ray.evaluate import __main__ as evaluate
from msk_ray.export import __main__ as export
from msk_ray.legs.gait import __main__ as gait
from msk_ray.report import __main__ as report
from msk_ray.tune import __main__ as tune
from msk_ray.visualize import __main__ as visualize

Main = Callable[[Sequence[str] | None], int]

CONFIG = "env: {name: cartpole, nworld: 8}\ntrial: {epochs: 2}\n"
SPACE = "question: Which rate?\nbase: good.yaml\nparameters: {shac.actor_lr: {grid: [0.01, 0.001]}}\n"
SEARCH = (
    "question: Which rate?\nbase: good.yaml\nsearch: optuna\nparameters: {shac.actor_lr: {uniform: [0.001, 0.01]}}\n"
)
MODEL = "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"


@dataclass(frozen=True)
class Mistake:
    """A command line of somebody who erred."""

    main: Main
    arguments: str
    """Separated by spaces."""
    line: str
    """Regular expression for its line."""
    config: str = CONFIG
    """Content of own.yaml."""
    space: str = SPACE
    """Content of space.yaml."""


def mistakes() -> list[Mistake]:
    """All of them."""

    def config(text: str, line: str) -> Mistake:
        return Mistake(train.main, "--config own.yaml --logdir new", line, config=text)

    def space(text: str, line: str) -> Mistake:
        return Mistake(tune.main, "--space space.yaml --dry-run", line, space=text)

    def training(arguments: str, line: str) -> Mistake:
        return Mistake(train.main, f"--config own.yaml {arguments}", line)

    def sweep(arguments: str, line: str) -> Mistake:
        return Mistake(tune.main, f"--space space.yaml --cpu {arguments}", line)

    return [
        # Names
        Mistake(any_command.main, "trian --config own.yaml", "no command 'trian'; write one of list, train, tune"),
        Mistake(train.main, "--config catpole", "unknown config 'catpole'; known: .*cartpole.*, or give a path"),
        Mistake(train.main, "--config gone.yaml", "no such file: gone.yaml; . holds: .*own"),
        Mistake(train.main, "--confg own.yaml", "no option --confg; did you mean --config?"),
        Mistake(train.main, "", "required: --config .*train --help"),
        Mistake(tune.main, "--space cartpole_smok --dry-run", "unknown space 'cartpole_smok'; known: .*cartpole_smoke"),
        Mistake(
            evaluate.main, "rats", "no checkpoint, trial or experiment 'rats'; .*; give a .pt file, a trial's folder"
        ),
        Mistake(
            report.main, "rats", "no checkpoint, trial or experiment 'rats'; .*; give a .pt file, a trial's folder"
        ),
        Mistake(status.main, "rats", "no experiment 'rats'"),
        Mistake(export.main, "cartpool --onnx p.onnx", "cartpool.*policies/ .*cartpole"),
        Mistake(gradcheck.main, "gone.xml", "no model file gone.xml"),
        sweep("--name a/b", "--name 'a/b': use at most 128 letters, digits"),
        # Configs
        config("env: [cartpole\n", "own.yaml is not valid YAML: "),
        config("- env\n", "own.yaml must hold a mapping of settings"),
        config("", "own.yaml must hold a mapping of settings"),
        config(CONFIG + "shac: {horizn: 8}\n", "shac.horizn: unknown key; did you mean 'horizon'?"),
        config(CONFIG + "sharc: {horizon: 8}\n", "sharc: unknown key; did you mean 'shac'?"),
        config(CONFIG + "horizon: 8\n", "horizon: unknown key"),
        config(
            CONFIG + "shac: {horizon: 8}\nshac: {gamma: 0.9}\n", "key 'shac' is written twice; leave one of them out"
        ),
        config(CONFIG + "5: 64\n", "key '5' is a whole number in YAML, not a name; write a name"),
        config("env: {name: cartpol}\n", "env.name: unknown name 'cartpol'; did you mean 'cartpole'?"),
        config("env: {name: 'hoppers:Hopper'}\n", "env.name: no module 'hoppers'; the current folder, PYTHONPATH"),
        config(
            "env: {name: 'model.xml'}\n", "env.name: unknown name 'model.xml'; write cartpole, .* package.module:Class"
        ),
        config("trial: {epochs: 2}\n", "own.yaml: env: missing; write it"),
        config(CONFIG + "shac: {gamma: 99}\n", "shac.gamma: Input should be less than or equal to 1, not 99"),
        config(CONFIG + "shac: {actor_lr: 1.0e-320}\n", "shac.actor_lr: Input should be greater than or equal to"),
        config(CONFIG + "shac: {reward_scale: 1.0e+308}\n", "shac.reward_scale: Input should be less than or equal"),
        config(CONFIG + "extends: gone.yaml\n", "no such file: .*gone.yaml; .* holds: good, own, space"),
        config(CONFIG + "algorithm: {name: sac}\n", "algorithm.name: unknown name 'sac'; did you mean 'shac'?"),
        config(CONFIG + "physics: {backward: autodiff}\n", "physics.backward: Input should be "),
        # Overrides
        training("--set shac.gamma", "--set 'shac.gamma': write key=value, such as shac.horizon=16"),
        training("--set shac.gama=0.9", "shac.gama: unknown key; did you mean 'gamma'?"),
        training("--set env.nworld=-4", "env.nworld: Input should be greater than 0, not -4"),
        training("--set shac.horizon=[8", "--set shac.horizon=.*: the value is not valid YAML"),
        training("--set ppo.lr=0.1", "--set ppo.lr: nothing reads it while algorithm.name is shac; leave it out"),
        training("--set trial.epochs.x=1", "trial.epochs.x: epochs is a value, not a section"),
        sweep("--dry-run --set shac.actor_lr=0.1", "--set shac.actor_lr: the space varies it; edit space.yaml"),
        # Seeds, numbers, devices
        training("--seed one", "--seed: invalid int value: 'one'"),
        training("--seed -1", "trial.seed: Input should be greater than or equal to 0, not -1"),
        training("--device gpu", "unknown device 'gpu': write cpu, cuda or cuda:0"),
        sweep("--dry-run --seeds 4-0", "seeds '4-0': 4-0 runs backwards; write 0-4"),
        sweep("--dry-run --seeds all", "seeds 'all': write whole numbers such as 0-4"),
        sweep("--max-concurrent 0", "--max-concurrent 0: at least 1"),
        sweep("--debug-trial 7", "no trial '7'; give 0 to 1, or an id from --dry-run"),
        Mistake(evaluate.main, "cartpole --worlds 0", "--worlds: "),
        # Spaces
        space("question: Q\nparameters: {}\n", "space.yaml: base: missing"),
        space(SPACE.replace("good", "gone"), "space.yaml: base: no such config file: gone.yaml"),
        space(SPACE.replace("grid", "gird"), "parameters.shac.actor_lr: unknown operator 'gird'; did you mean 'grid'?"),
        space(SPACE.replace("actor_lr", "actr_lr"), "shac.actr_lr: unknown key; did you mean 'actor_lr'?"),
        space(SPACE.replace("[0.01, 0.001]", "[0.01, 0.01]"), "come out as the same trial; drop one of them"),
        space(SPACE + "overrides: {on: 3}\n", "key 'on' is true or false in YAML, not a name; write a name, in quotes"),
        space(SPACE + "samples: 4\n", "samples: nothing is drawn; give a parameter choice, uniform"),
        space(SPACE + "scheduler: {kind: ahsa}\n", "scheduler.kind: .*asha"),
        space(SEARCH, r"search: optuna needs the package optuna, .*pip install 'msk-ray\[optuna\]'"),
        space(SEARCH.replace("optuna", "optuno"), "search: unknown name 'optuno'; did you mean 'optuna'?"),
        # Paths
        training("--logdir file.txt", "cannot write to file.txt: .*; choose another folder"),
        training("--logdir FOLDER\udcff", "its path is not UTF-8; rename it, or choose another folder"),
        training("--logdir new --resume", "--resume: no trial in new; leave out --resume to start one"),
        sweep("--storage file.txt", "file.txt.*; choose another folder"),
        sweep("--resume", "no experiment at .*; leave out --resume and --extend to start one"),
        Mistake(dashboard.main, "gone", "no folder gone: give the folder of your experiments"),
        Mistake(
            evaluate.main, "good.yaml", "good.yaml is not a checkpoint: give a .pt file, a trial's folder or an exp"
        ),
        # Policies
        Mistake(evaluate.main, "broken.pt --device cpu", "broken.pt is torn: .*; use an older one of"),
        Mistake(diagnose.main, "gone.pt", "no checkpoint gone.pt"),
        Mistake(gait.main, "cartpole --device cpu", "belongs to the package, .*: add --out DIR"),
        training(
            "--device cpu --logdir new --set trial.start_from=ant.pt",
            "trial.start_from: ant.pt does not fit this trial .*: give",
        ),
        Mistake(export.main, "cartpole --onnx p.pt", "--onnx p.pt: write a name that ends in .onnx"),
        Mistake(evaluate.main, "cartpole --physics moon --device cpu", "write one of reference, own"),
        Mistake(visualize.main, "cartpole --strip a.doc", "--strip a.doc: write a name that ends in .png"),
        Mistake(visualize.main, "cartpole --strip a.png --size 7x7", "write WIDTHxHEIGHT, both even"),
        Mistake(visualize.main, "cartpole --strip a.png --geom-groups 7", "write numbers from 0 to 5, such as 0,3"),
    ]


def make_place(folder: Path, mistake: Mistake, root: Path) -> None:
    """The files that a command line refers to."""
    (folder / "good.yaml").write_text(CONFIG)
    (folder / "own.yaml").write_text(mistake.config)
    (folder / "space.yaml").write_text(mistake.space)
    (folder / "model.xml").write_text(MODEL)
    (folder / "file.txt").write_text("text")
    (folder / "broken.pt").write_bytes((root / "policies" / "cartpole.pt").read_bytes()[:5000])
    (folder / "ant.pt").write_bytes((root / "policies" / "ant.pt").read_bytes())


def files(folder: Path) -> dict[str, bytes]:
    """All files below a folder with their contents."""
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("mistake", mistakes(), ids=lambda mistake: f"{mistake.main.__module__}: {mistake.arguments}")
def test_a_mistake_is_answered_in_one_line(
    mistake: Mistake,
    root: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "RAY_ADDRESS"):
        monkeypatch.delenv(name, raising=False)
    find_spec = packages.find_spec
    monkeypatch.setattr(packages, "find_spec", lambda name: None if name == "optuna" else find_spec(name))
    make_place(tmp_path, mistake, root)
    before = files(tmp_path)
    try:
        code = run(mistake.main, mistake.arguments.split())
    except SystemExit as end:
        code = end.code
    error = capfd.readouterr().err
    assert code not in (0, None)
    assert error.count("\n") == 1, error
    assert re.search(mistake.line, error), error
    assert error.startswith("error: ")
    assert len(error) < 1000
    assert "Traceback" not in error
    assert {name: files(tmp_path).get(name) for name in before} == before, "what was there stays as it was"


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("msk_ray trian", "no command 'trian'; write one of list, train, tune"),
        (
            "msk_ray.tune --spce space.yaml",
            "no option --spce; did you mean --space? (all options: python -m msk_ray.tune",
        ),
        ("msk_ray.train --config own.yaml --set shac.gamma=99", "shac.gamma: Input should be less than or equal to 1"),
    ],
)
def test_so_it_is_in_a_program(arguments: str, line: str, root: Path, tmp_path: Path) -> None:
    make_place(tmp_path, Mistake(train.main, "", ""), root)
    command = [sys.executable, "-m", *arguments.split()]
    environment = os.environ | {"PYTHONPATH": str(root)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert line in done.stderr
