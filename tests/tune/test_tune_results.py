"""Records, tables and the experiment's folder."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from msk_ray.cli import run
from msk_ray.config import Config, dump_yaml
from msk_ray.errors import ConfigError, DeviceError, StorageError
from msk_ray.experiment.manifest import Experiment, check_name
from msk_ray.experiment.outcomes import Ending, Outcome, read_ending, write_ending
from msk_ray.experiment.records import best_records, read_record, read_records
from msk_ray.experiment.results_table import outcome_name, result_rows, summary, table_document, variant_rows
from msk_ray.files import make_folder
from msk_ray.nvidia_smi import ask_driver
from msk_ray.status import main as status
from msk_ray.sweep import opening
from msk_ray.sweep.smoke import shorten
from msk_ray.sweep.space import ResourcesSpec
from msk_ray.sweep.trials import resolve_trials
from msk_ray.text_table import text_table
from msk_ray.tune.__main__ import main as tune
from msk_ray.tune.devices import Placement, choose_placement, processes_of, wait_for_memory
from msk_ray.tune.finish import finish, write_report

pytestmark = pytest.mark.long


def fill(experiment: Experiment, trial_id: str, scores: list[float | None], ending: Ending | None) -> None:
    """Metrics with an evaluation every second epoch, one of them written twice."""
    folder = experiment.trial_folder(trial_id)
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "checkpoints" / "best.pt").touch()
    rows: list[dict[str, Any]] = []
    for i, score in enumerate(scores):
        row: dict[str, Any] = {"epoch": 2 * i, "env_steps": 200 * i, "seconds": 1.0 * i, "eval/score": score}
        rows.append(row | ({"nonfinite": ["eval/score"]} if score is None else {}))
    text = "".join(json.dumps(row) + "\n" for row in [*rows, rows[-1]])
    (folder / "metrics.jsonl").write_text(text + '{"epoch": 9')  # torn in the middle of a row
    if ending is not None:
        write_ending(folder, ending)


@pytest.fixture
def experiment(make_space: Any, tmp_path: Path) -> Experiment:
    """Two rates, two seeds: finished, stopped, NaN, and never started."""
    space = make_space(seeds="0-1")
    trials = resolve_trials(space)
    made = opening.create(tmp_path / "runs" / "e", space, trials, {})
    fill(made, trials[0].id, [0.0, 5.0, 4.0], Ending(Outcome.FINISHED, "all done"))
    fill(made, trials[1].id, [0.0, 1.0], Ending(Outcome.STOPPED_ASHA, "number 2 of 2 | rung"))
    fill(made, trials[2].id, [0.0, 7.0, None], Ending(Outcome.NONFINITE, "score is nan"))
    return made


def test_records_and_tables(experiment: Experiment, tmp_path: Path) -> None:
    records = [read_record(t, experiment.trial_folder(t.id)) for t in experiment.trials()]
    assert [len(r.evaluations) for r in records] == [2, 1, 2, 0], "the untrained policy's does not count"
    assert [outcome_name(r) for r in records] == ["finished", "stopped_asha", "nonfinite", "waiting"]
    best = best_records(records).get("cartpole")
    assert best is records[2]
    rows = result_rows(records)
    assert [row[3] for row in rows] == ["7", "5", "1", "-"]
    assert rows[1][1:7] == ("actor_lr=0.01", "0", "5", "2", "4/20", "finished")
    # Rate 0.01: best scores 5 and 7, mean 6, deviation √2.
    assert variant_rows(records)[0] == ("actor_lr=0.01", "2", "6", "1.414", "5", "7")
    assert [row[1] for row in variant_rows(records)] == ["2", "1 (1 before the end)"]
    document = table_document("e", "Which?", records)
    assert "number 2 of 2 | rung" in document
    assert document.index(f"trials/{records[2].trial.id}") < document.index(f"trials/{records[0].trial.id}")
    assert "count with their best score so far" in document
    whole = table_document("e", "Which?", [records[0], records[2]])
    assert "before the" not in whole
    facts = json.loads(json.dumps(summary("e", "Which?", records), allow_nan=False))
    assert facts["best"]["cartpole"]["id"] == records[2].trial.id


def test_an_untrained_policy_has_no_score(experiment: Experiment, make_space: Any) -> None:
    """It scores higher than anything that was trained, and is all that two stopped trials have."""
    trials = experiment.trials()
    for number, scores in enumerate([[90.0, 5.0, 4.0], [90.0], [90.0, 7.0, None], [90.0]]):
        folder = experiment.trial_folder(trials[number].id)
        shutil.rmtree(folder, ignore_errors=True)
        fill(experiment, trials[number].id, scores, Ending(Outcome.STOPPED_ASHA, "behind"))
    records = [read_record(t, experiment.trial_folder(t.id)) for t in trials]
    assert [None if r.best is None else (r.best.score, r.best.epoch) for r in records] == [
        (5.0, 2),
        None,
        (7.0, 2),
        None,
    ]
    assert best_records(records).get("cartpole") is records[2]
    assert [row[3:5] for row in result_rows(records)] == [("7", "2"), ("5", "2"), ("-", "-"), ("-", "-")]
    assert [row[1] for row in variant_rows(records)] == ["2 (2 before the end)", "0"]
    facts = summary("e", "Which?", records)["trials"]
    assert [(f["score"], f["score_epoch"], f["best_checkpoint"] is None) for f in facts] == [
        (5.0, 2, False),
        (None, None, True),
        (7.0, 2, False),
        (None, None, True),
    ]
    shown = {record.trial.id: record.score for record in read_records(experiment)}
    assert [shown[trial.id] for trial in trials] == [5.0, None, 7.0, None]


def test_a_sweep_ends_in_its_report(experiment: Experiment, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_report(experiment)
    page = experiment.path / "report" / "index.html"
    assert f"report       {page}" in capfd.readouterr().out
    assert "Which rate?" in page.read_text()
    # Whatever becomes of it, the sweep's results stand, and the way to try again is named.
    write_report(Experiment(tmp_path / "nowhere"))
    shown = capfd.readouterr()
    assert "no report (exit code 2); to try again: python -m msk_ray.report" in shown.out


def test_an_existing_experiment_is_refused_and_a_changed_space_named(experiment: Experiment, make_space: Any) -> None:
    space = make_space(seeds="0-1")
    with pytest.raises(StorageError, match="already holds an experiment: add --resume"):
        opening.create(experiment.path, space, [], {})
    opening.reopen(experiment.path, resolve_trials(space))
    edited = make_space(seeds="0-1", overrides={"shac.gamma": 0.5})
    with pytest.raises(StorageError, match=r"trial 0 changed: shac.gamma 0.99 → 0.5"):
        opening.reopen(experiment.path, resolve_trials(edited))
    with pytest.raises(StorageError, match=r"2 gone \(actor_lr=0.01 seed 1"):
        opening.reopen(experiment.path, resolve_trials(make_space()))
    with pytest.raises(StorageError, match="no experiment at"):
        opening.reopen(experiment.path.with_name("other"), [])


def test_errored_trials_can_be_tried_again(experiment: Experiment) -> None:
    folders = [experiment.trial_folder(trial.id) for trial in experiment.trials()]
    write_ending(folders[0], Ending(Outcome.ERROR, "died"))
    experiment.clear_endings({Outcome.ERROR})
    assert [read_ending(folder) is None for folder in folders] == [True, False, False, True]


def test_space_is_kept_as_written(experiment: Experiment) -> None:
    assert "actor_lr" in (experiment.path / "space.yaml").read_text()
    environment = json.loads((experiment.path / "env.json").read_text())
    assert environment["packages"]["ray"]
    assert environment["gpus"] == list(ask_driver().gpus)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="cannot write to"):
        make_folder(tmp_path / "file" / "runs")
    with pytest.raises(StorageError, match="letters, digits"):
        check_name("../x")


def test_endings_round_trip(tmp_path: Path) -> None:
    assert read_ending(tmp_path) is None
    write_ending(tmp_path, Ending(Outcome.WALL_TIME, "60 s"))
    assert read_ending(tmp_path) == Ending(Outcome.WALL_TIME, "60 s")
    assert [path.name for path in tmp_path.iterdir()] == ["outcome.json"]


def test_placement() -> None:
    resources = ResourcesSpec()
    assert choose_placement(resources, None, cpu=False, gpus=0) == Placement(0.0, 1)
    assert choose_placement(resources, None, cpu=True, gpus=4) == Placement(0.0, 1)
    assert choose_placement(resources, 0.5, cpu=False, gpus=1).device == "cuda:0"
    with pytest.raises(DeviceError, match="there is no GPU; pass --cpu"):
        choose_placement(resources, 1.0, cpu=False, gpus=0)
    with pytest.raises(DeviceError, match="4 GPUs per trial requested, but there are 2"):
        choose_placement(resources, 4.0, cpu=False, gpus=2)
    for wrong in (0.0, -1.0, 1.5):
        with pytest.raises(ConfigError, match="write 1, 2"):
            choose_placement(resources, wrong, cpu=False, gpus=4)
    with pytest.raises(ConfigError, match="exclude"):
        choose_placement(resources, 1.0, cpu=True, gpus=4)


def test_placement_of_trials_of_several_gpus() -> None:
    resources = ResourcesSpec(cpus_per_trial=2)
    assert choose_placement(resources, None, cpu=False, gpus=4, processes=2) == Placement(2.0, 4)
    assert choose_placement(resources, 2.0, cpu=False, gpus=4, processes=2) == Placement(2.0, 4)
    assert choose_placement(resources, None, cpu=True, gpus=4, processes=2) == Placement(0.0, 4)
    with pytest.raises(DeviceError, match="4 GPUs per trial requested, but there are 2"):
        choose_placement(resources, None, cpu=False, gpus=2, processes=4)
    for asked, processes in ((2.0, 1), (0.5, 2), (1.0, 2)):
        with pytest.raises(ConfigError, match=rf"{asked:g} GPUs per trial, but execution\.gpus is {processes}"):
            choose_placement(ResourcesSpec(), asked, cpu=False, gpus=4, processes=processes)


def test_trials_of_one_experiment_have_as_many_gpus_each(tiny_cartpole: Config) -> None:
    two = tiny_cartpole.model_copy(update={"execution": tiny_cartpole.execution.model_copy(update={"gpus": 2})})
    assert processes_of([two, two]) == 2
    with pytest.raises(ConfigError, match=r"execution\.gpus is 1 and 2"):
        processes_of([tiny_cartpole, two])
    assert shorten(two)["env.nworld"] == 8
    three = two.model_copy(update={"execution": two.execution.model_copy(update={"gpus": 3})})
    assert shorten(three)["env.nworld"] == 6


def test_the_memory_of_a_dead_trial_is_waited_for() -> None:
    paused: list[float] = []
    shares = iter([0.1, 0.1, 0.95])
    assert wait_for_memory(1.0, lambda: next(shares), 60.0, paused.append) is None
    assert len(paused) == 2
    # A quarter of a GPU needs a quarter of its memory.
    assert wait_for_memory(0.25, lambda: 0.3, 60.0, paused.append) is None
    assert len(paused) == 2
    assert wait_for_memory(1.0, lambda: 0.4, 5.0, paused.append) == 0.4
    assert sum(paused[2:]) == 5.0


def test_concurrent_trials() -> None:
    assert Placement(0.0, 1).concurrent(0, 2, None) == 2
    assert Placement(1.0, 1).concurrent(4, 64, None) == 4
    assert Placement(0.4, 1).concurrent(2, 64, None) == 4  # two on each GPU; 0.2 of each is left over
    assert Placement(1.0, 1).concurrent(4, 64, 3) == 3
    assert [Placement(share, 1).concurrent(1, 64, None) for share in (0.1, 0.2, 1 / 3)] == [10, 5, 3]


def test_text_table_cuts_the_end_only() -> None:
    text = text_table(("id", "why"), [("a1", "x" * 50)], width=20)
    assert text.splitlines()[2] == "a1  " + "x" * 15 + "…"


def test_labels_and_reasons_reach_neither_terminal_nor_markdown_as_they_are(
    make_space: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evil = "\x1b[2J\n| <script>alert(1)</script>"
    levels = [{"label": f"a{evil}", "value": 0.01}, {"label": "b [bold]:smile:", "value": 0.001}]
    space = make_space(parameters={"shac.actor_lr": {"grid": levels}}, question=f"Which?{evil}")
    made = opening.create(tmp_path / "runs" / "e", space, resolve_trials(space), {})
    for trial in made.trials():
        fill(made, trial.id, [0.0, 5.0], Ending(Outcome.ERROR, f"because{evil}"))
    finish(made)
    assert run(status, ["e", "--storage", str(tmp_path / "runs")]) == 0
    assert run(status, ["--storage", str(tmp_path / "runs")]) == 0
    file = tmp_path / "space.yaml"
    file.write_text(dump_yaml({**space.file.model_dump(exclude_unset=True), "base": str(tmp_path / "base.yaml")}))
    assert run(tune, ["--space", str(file), "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert "\x1b" not in shown
    assert "\\x1b[2J" in shown
    assert "[bold]:smile:" in shown
    table = (made.path / "table.md").read_text()
    assert "\x1b" not in table
    # Indented lines are shown literally.
    assert all(line.startswith("    ") or not line for line in table.splitlines())
    assert len([line for line in table.splitlines() if "trials/" in line]) == 2
