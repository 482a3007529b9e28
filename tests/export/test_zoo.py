"""A policy put into a zoo is the trial's own, with what it scores and where it comes from; evaluate says whether that
is still true."""

import shutil
from pathlib import Path

import myosuite_model
import pytest
import torch
import yaml
from needs import need_file, slow

import msk_ray
from msk_ray.cli import run
from msk_ray.config import Config, overlay, parse_config, parse_recorded
from msk_ray.errors import ConfigError
from msk_ray.evaluate import zoo as reading
from msk_ray.evaluate.__main__ import main as evaluate
from msk_ray.evaluate.measure import Bench, Request
from msk_ray.evaluate.zoo import BEGIN, END, MAX_BYTES, Score, read_zoo, zoo_text
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.records import best_records, read_records
from msk_ray.export import zoo as writing
from msk_ray.export.__main__ import main as export
from msk_ray.export.write import export as export_files
from msk_ray.shipped import shipped_folder
from msk_ray.visualize.__main__ import main as visualize

pytestmark = pytest.mark.long

SHIPPED = shipped_folder() / "policies"
SECONDS = 0.5
"""How long each trained policy acts here."""


POLICIES = sorted(SHIPPED.glob("*.pt"))
ALWAYS = ("ant_hard", "cartpole", "go1_velocity", "myoleg26")
"""One of each kind: with contacts, without, with commands and a memory, with muscles."""


@pytest.mark.parametrize(
    "path",
    [*(p for p in POLICIES if p.stem in ALWAYS), *slow(*(p for p in POLICIES if p.stem not in ALWAYS))],
    ids=lambda path: path.stem,
)
def test_every_trained_policy_is_exported_and_does_what_is_recorded(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert path.stat().st_size <= MAX_BYTES
    entry = reading.read_entry(path)
    if entry.env == "myosuite_walk":
        need_file(myosuite_model.PACKAGE / "myosuite" / "__init__.py", "make env")
        monkeypatch.syspath_prepend(myosuite_model.PACKAGE)  # its model
    saved = msk_ray.load_policy(path)
    assert parse_recorded(entry.config, path.name) == saved.config
    assert entry.trained.command
    assert entry.trained.commit
    # What differs by more than 1e-5 is refused.
    assert "differs by at most" in next(export_files(path, {"onnx": tmp_path / "p.onnx"}, "reference"))
    steps = round(SECONDS / saved.config.env.control_timestep)
    result = Bench("cpu").evaluate(saved, Request(worlds=2, steps=steps))
    assert result["physics"] == entry.score.physics
    assert result["diverged_rate"] == 0.0
    if entry.score.fell < 0.01:
        assert result["length"]["mean"] == min(steps, entry.score.steps)


def test_the_readme_of_the_trained_policies_is_made_from_their_entries() -> None:
    shown = (SHIPPED / "README.md").read_text().split(BEGIN)[1].split(END)[0].strip()
    assert shown == zoo_text(read_zoo(SHIPPED))


@pytest.fixture(scope="module")
def made(sweep: Experiment, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A zoo with the best policy of the small sweep, made by the command. Not to be changed."""
    folder = tmp_path_factory.mktemp("zoo")
    (folder / "README.md").write_text(f"# Mine\n\n{BEGIN}\nold\n{END}\nThe end.\n")
    command = [str(sweep.path), "--zoo", str(folder / "pole"), "--seeds", "0-1", "--device", "cpu"]
    assert run(export, [*command, "--machine", "1 × Thinker"]) == 0
    return folder


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "zoo"))


def test_an_entry_says_what_the_policy_scores_and_where_it_comes_from(made: Path, sweep: Experiment) -> None:
    best = best_records(read_records(sweep)).get("cartpole")
    assert best is not None
    assert best.best is not None
    ours = msk_ray.load_policy(best.folder / "checkpoints" / "best.pt")
    stored = msk_ray.load_policy(made / "pole.pt")
    obs = torch.randn(9, 5, generator=torch.Generator().manual_seed(0))
    assert torch.equal(stored(obs), ours(obs))
    assert not {"critic", "target_critic"} & set(stored.modules), "without the means to train it"
    (entry,) = read_zoo(made).values()
    result = Bench("cpu").evaluate(ours, Request(seeds=(0, 1)))
    assert entry.score.mean == pytest.approx(result["score"]["mean"], abs=1e-4)
    assert list(entry.score.by_seed) == [0, 1]
    assert entry.score.episodes == 8
    trained = entry.trained
    assert f"# trial {best.trial.id}: {best.trial.variant}, seed {best.trial.seed}" in trained.command
    assert (trained.machine, trained.epoch, trained.epochs) == ("1 × Thinker", best.best.epoch, 6)
    assert trained.chosen == "the best evaluation"
    assert trained.seconds == pytest.approx(best.best.seconds, abs=0.1)
    text = (made / "README.md").read_text()
    assert text.startswith("# Mine\n")
    assert text.endswith(f"{END}\nThe end.\n")
    assert f"| `pole.pt` | {entry.score.mean:.5g} ± {entry.score.std:.3g} | 2 × 4 |" in text
    assert "\nold\n" not in text


def test_evaluate_repeats_the_table_or_says_what_differs(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [str(copy), "--device", "cpu"]
    assert run(evaluate, command) == 0
    out = capsys.readouterr().out
    assert "; as recorded" in out
    assert reading.zoo_table(read_zoo(copy)) in out
    path = copy / "pole.yaml"
    facts = yaml.safe_load(path.read_text())
    facts["score"]["mean"] += 1e6
    path.write_text(yaml.safe_dump(facts))
    assert run(evaluate, command) == 1
    assert "more than 3 standard errors away" in capsys.readouterr().out


def test_scores_agree_within_three_standard_errors() -> None:
    other = {"by_seed": {0: 0.0}, "steps": 1, "length": 1, "physics": "own", "fell": 0, "diverged": 0, "outcomes": {}}
    one, two = (Score(mean=mean, std=30.0, worlds=100, device="cpu", **other) for mean in (1000.0, 1012.0))
    assert one.agrees(two)  # the difference has a standard error of √(3² + 3²) = 4.24
    assert not one.agrees(two.model_copy(update={"mean": 1013.0}))


def test_a_checkpoint_other_than_the_best_says_how_it_was_chosen(
    sweep: Experiment, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = sweep.trial_folder(sweep.trials()[0].id) / "checkpoints" / "epoch_000006.pt"
    command = [str(checkpoint), "--zoo", str(copy / "pole"), "--seeds", "0", "--device", "cpu", "--machine", "x"]
    assert run(export, command) == 2
    assert "epoch_000006.pt is not the best.pt of its trial: say how it was chosen" in capsys.readouterr().err
    assert run(export, [*command, "--chosen", "the newest checkpoint"]) == 0
    assert read_zoo(copy)["pole"].trained.chosen == "the newest checkpoint"
    assert "; the newest checkpoint (epoch 6 of 6); scored on" in (copy / "README.md").read_text()


def test_a_large_policy_is_stored_in_half_precision_and_scored_so(
    sweep: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def add() -> reading.Entry:
        command = [str(sweep.path), "--zoo", str(tmp_path / "small"), "--seeds", "0", "--device", "cpu"]
        assert run(export, [*command, "--machine", "x"]) == 0
        return read_zoo(tmp_path)["small"]

    whole, size = add(), (tmp_path / "small.pt").stat().st_size
    monkeypatch.setattr(writing, "MAX_BYTES", size + 1000)
    half = add()
    assert (whole.weights, half.weights) == ("float32", "float16")
    modules = msk_ray.load_policy(tmp_path / "small.pt").modules
    kinds = {value.dtype for value in modules["actor"].values() if value.dim() == 2}
    assert kinds == {torch.float16}
    assert all(value.dtype != torch.float16 for value in modules["normalizer"].values())
    assert half.score.mean != whole.score.mean, "the score is that of the stored weights"
    assert half.score.mean == pytest.approx(whole.score.mean, rel=0.01)
    monkeypatch.setattr(writing, "MAX_BYTES", 3000)
    assert run(export, [str(sweep.path), "--zoo", str(tmp_path / "none"), "--device", "cpu", "--machine", "x"]) == 2
    assert not (tmp_path / "none.pt").exists()


def test_paths_of_this_machine_are_left_out_or_refused(tiny_cartpole: Config) -> None:
    config = parse_config(overlay(tiny_cartpole.as_dict(), {"trial.start_from": "/home/me/best.pt"}))
    portable, said = writing._portable(config)
    assert portable.trial.start_from is None
    assert said == ["trial.start_from: left out, being a path of this machine"]
    assert writing._portable(portable) == (portable, [])
    model = parse_config({"env": {"name": "hopper:Hopper", "model": "/home/me/robot.xml"}})
    with pytest.raises(ConfigError, match=r"env.model: a path of this machine cannot go into a zoo"):
        writing._portable(model)


def test_commands_are_recorded_without_folders_of_this_machine() -> None:
    program = str(Path(msk_ray.__file__).with_name("train.py"))
    words = [program, "--config", "/home/me/ant.yaml", "--set", "shac.horizon=16", "--logdir", "runs/mine"]
    shown = "python -m msk_ray.train --config ant.yaml --set shac.horizon=16 --logdir runs/mine"
    assert writing._without_folders(words) == shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--zoo", "p"], "does not say with which machine it was trained: add --machine TEXT"),
        (["--zoo", "p.pt"], "write FOLDER/NAME, without a suffix"),
        (["--zoo", "p", "--onnx", "p.onnx"], "writes no other files"),
        (["--onnx", "p.onnx", "--seeds", "0"], "--seeds: only --zoo reads it"),
        (["--zoo", "p", "--seeds", "a"], "write whole numbers"),
    ],
)
def test_bad_input_of_export_is_one_line(
    sweep: Experiment,
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(export, [str(sweep.path), *arguments]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert message in error
    assert not list(tmp_path.iterdir())


def test_bad_input_of_a_zoo_is_one_line(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(command: object, *arguments: str) -> str:
        assert run(command, [str(copy), *arguments]) == 2
        (error,) = capsys.readouterr().err.splitlines()
        return error

    for option, value in (("--worlds", "3"), ("--with", "push")):
        assert f"{option}: the policies of {copy} are evaluated as recorded there" in refused(evaluate, option, value)
    assert "holds several policies; give one of them: pole.pt" in refused(visualize, "--no-render")
    shutil.copy(SHIPPED / "cartpole.pt", copy / "pole.pt")
    assert "pole.yaml is about another policy than pole.pt" in refused(evaluate)
    (copy / "pole.yaml").write_text("format: 2\n")
    assert "pole.yaml: format" in refused(evaluate)
    (copy / "pole.yaml").unlink()
    assert "no such file" in refused(evaluate)
