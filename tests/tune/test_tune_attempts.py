"""A trial that runs out of memory restarts once with half its worlds, whichever process dies, and all tables say so."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from stub_trainer import BEHAVIOUR, CROWD, LATE_CROWD, MEMORY, StubTrainer
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from msk_ray.cli import run
from msk_ray.config import dump_yaml, read_yaml
from msk_ray.errors import ConfigError
from msk_ray.experiment import attempts
from msk_ray.experiment.attempts import FIRST, Attempt, WorldReduction, read_attempt
from msk_ray.experiment.evaluation_log import EvaluationLog, LogEntry
from msk_ray.experiment.layout import ABANDONED, EVALUATION_LOG_FILE
from msk_ray.experiment.metrics import read_rows
from msk_ray.experiment.outcomes import Ending, Outcome, read_ending, write_ending
from msk_ray.experiment.records import read_records
from msk_ray.experiment.results_table import reduced_note, result_rows, summary, table_document, variant_rows
from msk_ray.experiment.trial import Trial
from msk_ray.signals import RESUMABLE
from msk_ray.sweep import opening
from msk_ray.sweep.rules.scheduler import replay
from msk_ray.sweep.rules.stopping import StopSpec
from msk_ray.sweep.space import read_file
from msk_ray.sweep.trials import resolve_trials
from msk_ray.training import Trainer, read_checkpoint
from msk_ray.tune import driver, trial_run
from msk_ray.tune.__main__ import main
from msk_ray.tune.devices import Placement
from msk_ray.tune.trial_run import Hooks


@pytest.fixture
def crowded(make_space: Any) -> Callable[..., Trial]:
    """A trial of 8 worlds that misbehaves in some way."""

    def make(behaviour: float, **overrides: Any) -> Trial:
        changes = {BEHAVIOUR: behaviour} | {k.replace("__", "."): v for k, v in overrides.items()}
        return resolve_trials(make_space(parameters={}, overrides=changes))[0]

    return make


def attempt(trial: Trial, folder: Path, may_halve: bool = True, trainer: Any = StubTrainer) -> Ending | None:
    folder.mkdir(parents=True, exist_ok=True)
    return trial_run.run_trial(trial, folder, "cpu", StopSpec(), trainer, Hooks(), may_halve=may_halve)


def epochs(folder: Path) -> list[float]:
    """As they stand in the file, repeats and order included."""
    return [json.loads(line)["epoch"] for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_only_if_asked_to(crowded: Any, tmp_path: Path) -> None:
    ending = attempt(crowded(LATE_CROWD), tmp_path, may_halve=False)
    assert ending == Ending(Outcome.OUT_OF_MEMORY, "out_of_memory: made up")
    assert read_attempt(tmp_path) == FIRST
    assert epochs(tmp_path) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("behaviour", "done"), [(CROWD, []), (LATE_CROWD, [0, 1, 2, 3, 4])])
def test_half_the_worlds_from_the_beginning(
    behaviour: float, done: list[int], crowded: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = crowded(behaviour)
    assert attempt(trial, tmp_path) is None
    assert read_ending(tmp_path) is None
    assert not (tmp_path / "error.txt").exists()
    assert epochs(tmp_path) == []
    if done:
        assert epochs(tmp_path / ABANDONED) == done
        assert [path.name for path in sorted((tmp_path / ABANDONED / "checkpoints").glob("epoch_*.pt"))] == [
            "epoch_000002.pt",
            "epoch_000004.pt",
        ]
    said = capsys.readouterr().out
    assert "the trial restarts with half the worlds: 4 of 8; its work so far is in" in said
    ending = attempt(trial, tmp_path)
    assert ending is not None
    assert ending.outcome is Outcome.FINISHED
    assert epochs(tmp_path) == list(range(21))
    assert capsys.readouterr().out.splitlines()[:2] == ["half the worlds: 4 of 8", "starting"]
    assert read_yaml(tmp_path / "config.yaml")["env"]["nworld"] == 4
    assert (tmp_path / "config.yaml").read_text().startswith("# half the worlds: 4 of 8 asked for\n")


def test_a_damaged_outcome_is_said_and_the_trial_goes_on(
    crowded: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = crowded(0.0)
    assert attempt(trial, tmp_path) == Ending(Outcome.FINISHED, "all 20 epochs done")
    (tmp_path / "outcome.json").write_bytes(b"\xff\xfe")
    assert attempt(trial, tmp_path) == Ending(Outcome.FINISHED, "all 20 epochs done")
    assert "outcome.json: not UTF-8 text" in capsys.readouterr().out
    assert [row["epoch"] for row in read_rows(tmp_path)] == list(range(21))
    assert read_ending(tmp_path) == Ending(Outcome.FINISHED, "all 20 epochs done")


def test_a_trial_whose_checkpoints_are_gone_says_that_it_starts_again(
    crowded: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = crowded(0.0)
    attempt(trial, tmp_path)
    assert "starting\n" in capsys.readouterr().out
    (tmp_path / "outcome.json").unlink()
    for checkpoint in (tmp_path / "checkpoints").glob("epoch_*.pt"):
        checkpoint.unlink()
    assert attempt(trial, tmp_path) == Ending(Outcome.FINISHED, "all 20 epochs done")
    assert "starting again: there is no complete checkpoint of the 20 epochs it had run" in capsys.readouterr().out
    assert [row["epoch"] for row in read_rows(tmp_path)] == list(range(21))


def test_a_trial_whose_number_of_worlds_is_damaged_ends_and_says_what_to_write(crowded: Any, tmp_path: Path) -> None:
    trial = crowded(LATE_CROWD)
    assert attempt(trial, tmp_path) is None
    (tmp_path / "halved.json").write_text("null")
    before = sorted(path.name for path in tmp_path.rglob("*"))
    ending = attempt(trial, tmp_path)
    assert ending is not None
    assert ending.outcome is Outcome.ERROR
    assert "halved.json: null instead of a JSON object" in ending.why
    assert "--resume --retry error" in ending.why
    assert sorted({path.name for path in tmp_path.rglob("*")} - {"outcome.json"}) == sorted(set(before))


@pytest.mark.parametrize("where", ["before anything is set aside", "after the first file", "after the last one"])
def test_a_process_killed_after_the_decision_halves_no_second_time(
    where: str, crowded: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        """Nothing in the process outlives it."""

    def die(*args: Any) -> None:
        raise Killed

    trial = crowded(LATE_CROWD)
    with monkeypatch.context() as patch:
        if where == "before anything is set aside":
            mkdir = Path.mkdir

            def make_others(path: Path, **options: Any) -> None:
                if path.name == ABANDONED:
                    die()
                mkdir(path, **options)

            patch.setattr(Path, "mkdir", make_others)
        elif where == "after the last one":
            patch.setattr(attempts, "write_text", die)
        else:
            rename, moved = Path.rename, list[Path]()

            def rename_once(path: Path, target: Path) -> None:
                if path.parent == tmp_path and not path.name.startswith("."):
                    moved.append(path)
                    if len(moved) > 1:
                        die()
                rename(path, target)

            patch.setattr(Path, "rename", rename_once)
        with pytest.raises(Killed):
            attempt(trial, tmp_path)
    assert read_attempt(tmp_path) == Attempt(WorldReduction(8, 4, "out_of_memory: made up", cleared=False))
    ending = attempt(trial, tmp_path)
    assert ending is not None
    assert ending.outcome is Outcome.FINISHED
    assert read_attempt(tmp_path) == Attempt(WorldReduction(8, 4, "out_of_memory: made up", cleared=True))
    assert epochs(tmp_path) == list(range(21))
    assert epochs(tmp_path / ABANDONED) == [0, 1, 2, 3, 4]
    assert (tmp_path / ABANDONED / "checkpoints" / "epoch_000004.pt").is_file()


def test_the_second_time_it_ends(crowded: Any, tmp_path: Path) -> None:
    trial = crowded(MEMORY)
    assert attempt(trial, tmp_path) is None
    ending = attempt(trial, tmp_path)
    why = "out_of_memory: made up; 8 worlds were asked for, and half of them has been tried"
    assert ending == Ending(Outcome.OUT_OF_MEMORY, why) == read_ending(tmp_path)
    assert read_yaml(tmp_path / "config.yaml")["env"]["nworld"] == 4


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"env__nworld": 1, "shac__critic_batches": 1}, "a single world cannot be halved"),
        ({"env__nworld": 3, "shac__critic_batches": 3}, "critic_batches 3 must divide"),
    ],
)
def test_what_cannot_be_halved_ends_at_once_and_says_so(
    settings: dict[str, Any], why: str, crowded: Any, tmp_path: Path
) -> None:
    ending = attempt(crowded(MEMORY, **settings), tmp_path)
    assert ending is not None
    assert ending.outcome is Outcome.OUT_OF_MEMORY
    assert "; half of them could not be tried: " in ending.why
    assert why in ending.why
    assert "\n" not in ending.why
    assert read_attempt(tmp_path) == FIRST


def test_a_real_trainer_leaves_one_curve(
    tiny_settings: dict[str, Any], make_space: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Crowded(Trainer):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            update = self.algorithm.update

            def crowded(epoch: int) -> Any:
                if epoch == 3 and self.env.nworld > 4:
                    raise RuntimeError("Failed to allocate 8589934592 bytes on device 'cuda:0'")
                return update(epoch)

            monkeypatch.setattr(self.algorithm, "update", crowded)

    (tmp_path / "base.yaml").write_text(dump_yaml(tiny_settings))
    (trial,) = resolve_trials(make_space(parameters={}))
    folder = tmp_path / trial.id
    assert attempt(trial, folder, trainer=Crowded) is None
    assert epochs(folder / ABANDONED) == [0, 1, 2, 3]
    ending = attempt(trial, folder, trainer=Crowded)
    assert ending is not None
    assert ending.outcome is Outcome.FINISHED
    assert epochs(folder) == list(range(7))
    # horizon × worlds: rows of 8 worlds would count twice as many.
    assert [row["env_steps"] for row in read_rows(folder)] == [8 * 4 * epoch for epoch in range(7)]
    assert read_checkpoint(folder / "checkpoints" / "epoch_000006.pt")["config"]["env"]["nworld"] == 4
    assert (folder / "config.yaml").read_text().startswith("# half the worlds: 4 of 8 asked for\n")
    board = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    board.Reload()
    assert [(e.step, e.value) for e in board.Scalars("progress/env_steps")] == [(n, 32.0 * n) for n in range(7)]


@pytest.mark.parametrize("kind", ["asha", "median"])
def test_early_stopping_forgets_the_attempt_with_all_worlds(kind: Any) -> None:
    shared = {"kind": kind, "grace": 0.5, "min_trials": 2} | ({"reduction": 2.0} if kind == "asha" else {})
    spec = read_file({"question": "?", "base": "b", "scheduler": shared}, "space").scheduler
    others = [LogEntry(name, 5, 500, 1.0, score, False) for name, score in (("a", 5.0), ("b", 4.0))]
    before = [LogEntry("c", 6, 600, 1.0, 9.0, False)]
    halves = [LogEntry("c", 5, 500, 1.0, 1.0, False, attempt=2)]
    with_all = replay(spec.pruner(1000), "env_steps", [*before, *others, *halves])
    without = replay(spec.pruner(1000), "env_steps", [*others, *halves])
    assert with_all is not None
    assert with_all == without


@pytest.mark.parametrize("halved_after", [False, True])
def test_a_stop_that_was_not_carried_out_is_void_once_the_worlds_are_halved(
    halved_after: bool, make_space: Any, tmp_path: Path
) -> None:
    space = make_space(scheduler={"kind": "asha", "grace": 0.5, "reduction": 2.0, "min_trials": 2})
    trials = resolve_trials(space)
    experiment = opening.create(tmp_path / "e", space, trials, {})
    good, bad = (trial.id for trial in trials)
    experiment.trial_folder(bad).mkdir()
    for name, score in ((good, 2.0), (bad, 1.0)):  # at the rung, half of 20 epochs × 64 env steps
        EvaluationLog(experiment.path / EVALUATION_LOG_FILE).append(LogEntry(name, 10, 640, 1.0, score, False))
    if halved_after:
        Attempt(WorldReduction(8, 4, "no room")).write(experiment.trial_folder(bad))
    driver._finish_pruning(driver.Plan(experiment, space, trials, Placement(0.0, 1), None))
    ending = read_ending(experiment.trial_folder(bad))
    assert (ending and ending.outcome) == (None if halved_after else Outcome.STOPPED_ASHA)


def test_a_population_cannot(make_space: Any) -> None:
    with pytest.raises(ConfigError, match="all need the same number; write false"):
        make_space(
            parameters={"shac.actor_lr": {"loguniform": [1e-4, 1e-2]}},
            scheduler={"kind": "pbt"},
            resources={"halve_worlds_on_oom": True},
        )


def test_what_the_command_line_said_is_kept_until_it_says_otherwise(
    space_data: dict[str, Any], tmp_path: Path, plans: list[driver.Plan]
) -> None:
    space = tmp_path / "small.yaml"
    space.write_text(dump_yaml(space_data))

    def halves(*arguments: str) -> bool:
        code = run(main, ["--space", str(space), "--cpu", "--storage", str(tmp_path / "runs"), *arguments])
        assert code == RESUMABLE
        return plans.pop().space.file.resources.halve_worlds_on_oom

    assert halves("--halve-worlds")
    assert read_yaml(tmp_path / "runs" / "small" / "space.yaml")["resources"] == {"halve_worlds_on_oom": True}
    assert halves("--resume")
    assert not halves("--resume", "--no-halve-worlds")
    assert not halves("--resume")
    assert halves("--resume", "--halve-worlds")
    assert not halves("--name", "other")
    # Where nothing was said, the space file decides, as it does on all resources.
    space.write_text(dump_yaml(space_data | {"resources": {"halve_worlds_on_oom": True, "max_failures": 1}}))
    assert halves("--name", "other", "--resume")


def test_tables_say_so(make_space: Any, tmp_path: Path) -> None:
    space = make_space(seeds="0-1")
    trials = resolve_trials(space)
    experiment = opening.create(tmp_path / "e", space, trials, {})
    for trial in trials:
        folder = experiment.trial_folder(trial.id)
        folder.mkdir()
        row = {"epoch": 20, "env_steps": 1, "seconds": 1.0, "eval/score": 1.0 + trial.index}
        (folder / "metrics.jsonl").write_text(json.dumps(row) + "\n")
        write_ending(folder, Ending(Outcome.FINISHED, "all 20 epochs done"))
    assert reduced_note(read_records(experiment)) is None
    Attempt(WorldReduction(8, 4, "no room", cleared=True)).write(experiment.trial_folder(trials[3].id))
    records = read_records(experiment)
    best = result_rows(records)[0]
    assert best[6] == "finished, half the worlds"
    assert best[8] == "half the worlds: 4 of 8; all 20 epochs done"
    assert [row[6] for row in result_rows(records)[1:]] == ["finished"] * 3
    assert [row[1] for row in variant_rows(records)] == ["2 (1 with half the worlds)", "2"]
    document = table_document("e", "Which?", records)
    assert "half the worlds: 4 of 8; all 20 epochs done" in document
    assert "1 trial ran with half the worlds asked for" in document
    facts = summary("e", "Which?", records)
    assert [trial["halved"] for trial in facts["trials"]] == [None, None, None, {"asked": 8, "worlds": 4}]
