"""Policies scored together get the scores that they get alone, and none is lost or counted twice."""

import json
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from test_trainer import comparable

from msk_ray import training
from msk_ray.algorithms import algorithm_class
from msk_ray.cli import run
from msk_ray.config import Config, dump_yaml, load_config, overlay, parse_config
from msk_ray.errors import Failure, SimulationError, StorageFailure
from msk_ray.experiment.checkpoint_format import read_facts
from msk_ray.train import main
from msk_ray.training import Evaluator, Trainer, read_metrics
from msk_ray.training.checkpoint import milestones, read_checkpoint, unscored_checkpoints
from msk_ray.training.policy_group import Policy

pytestmark = pytest.mark.long


def tiny() -> dict[str, Any]:
    """A trial with evaluations after epochs 0, 2, 4 and 6."""
    return {
        "env": {"name": "cartpole", "nworld": 4, "episode_length": 40},
        "shac": {"horizon": 4, "critic_iterations": 1, "critic_batches": 1},
        "actor": {"hidden": [8]},
        "critic": {"hidden": [8]},
        "evaluation": {"interval": 2, "nworld": 2, "steps": 20},
        "trial": {"epochs": 6},
        "execution": {"checkpoint_interval": 2, "loggers": []},
    }


def train(config: Config, folder: Path, together: int) -> list[dict]:
    trainer = Trainer(config, folder, "cpu", together)
    while not trainer.finished:
        trainer.run_epoch()
    trainer.close()
    return read_metrics(folder / "metrics.jsonl")


def policies(config: Config, evaluator: Evaluator, count: int) -> list[Policy]:
    """Untrained policies that differ."""
    made = []
    for seed in range(count):
        other = config.model_copy(update={"trial": config.trial.model_copy(update={"seed": seed})})
        env = evaluator.env
        made.append(algorithm_class(other).policy_network(other, env.obs_size, env.action_size))
    return made


@pytest.fixture(params=["cartpole", "ant"])
def small(request: pytest.FixtureRequest, root: Path) -> Config:
    sizes = ["evaluation.nworld=3", "evaluation.steps=60", "actor.hidden=[16,16]", "actor.output_gain=3"]
    return load_config(root / "configs" / f"{request.param}.yaml", sizes)


def test_scores_of_several_are_those_of_each_alone(small: Config) -> None:
    """Five policies with room for three: a full batch, and one with worlds left over."""
    alone, together = Evaluator(small, "cpu"), Evaluator(small, "cpu", policies=3)
    some = policies(small, alone, 5)
    expected = [alone.run([policy])[0] for policy in some]
    assert together.run(some) == expected
    assert len({figures["score"] for figures in expected}) == 5


def test_a_policy_whose_episodes_have_all_ended_has_no_success_beside_one_that_goes_on() -> None:
    """The worlds of the third policy never fall, and succeed; alone, those of the others would end the evaluation."""
    config = parse_config(tiny() | {"evaluation": {"steps": 60, "nworld": 2}})
    pushes = [lambda obs, push=push: torch.full((len(obs), 1), push) for push in (1.0, -1.0, 0.0)]

    def figures(count: int, some: list[Policy]) -> list[dict[str, float]]:
        evaluator = Evaluator(config, "cpu", policies=count)
        env: Any = evaluator.env
        env.fell = lambda state: state.qvel[:, 0].abs() > 1.0
        env.success = lambda tail: torch.ones(env.nworld, dtype=torch.bool)
        env.outcome_terms = lambda state: {"speed": state.qvel[:, 0]}
        return evaluator.run(some)

    found = figures(3, pushes)
    assert found == [figures(1, [push])[0] for push in pushes]
    assert ["success_rate" in each for each in found] == [False, False, True]
    assert found[0]["fall_rate"] == 1.0
    assert found[0]["length"] < 60


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trial whose policies were scored at once. Not to be changed."""
    folder = tmp_path_factory.mktemp("whole")
    train(parse_config(tiny()), folder, 1)
    return folder


def check_record(folder: Path, expected: Path) -> None:
    """Rows, best.pt and the policies kept on the way are those of another trial, and nothing waits."""
    rows, others = (read_metrics(f / "metrics.jsonl") for f in (folder, expected))
    assert comparable(rows) == comparable(others)
    kept, reference = (
        [f / "checkpoints" / "best.pt", *dict(milestones(f / "checkpoints")).values()] for f in (folder, expected)
    )
    assert [path.name for path in kept] == [path.name for path in reference]
    for paths in zip(kept, reference, strict=True):
        facts = [{k: v for k, v in read_facts(p).items() if k in ("epoch", "score", "best_score")} for p in paths]
        assert facts[0] == facts[1]
        modules, others = (read_checkpoint(p)["algorithm"]["modules"] for p in paths)
        assert list(modules) == list(others)
        assert torch.equal(modules["actor"]["mean.0.weight"], others["actor"]["mean.0.weight"])
    assert not unscored_checkpoints(folder / "checkpoints")


def test_a_trial_has_the_same_record_in_the_end(whole: Path, tmp_path: Path) -> None:
    train(parse_config(tiny()), tmp_path, 3)
    check_record(tmp_path, whole)


def test_rows_are_written_before_their_scores_are_known(tmp_path: Path) -> None:
    """Evaluations after epochs 0, 2, 4 and 6; the third fills the batch."""
    trainer = Trainer(parse_config(tiny()), tmp_path, "cpu", 3)
    for _ in range(3):
        row = trainer.run_epoch()
    assert "eval/score" not in row
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert [r["epoch"] for r in rows] == [0, 1, 2, 3]
    assert not any("eval/score" in r for r in rows)
    assert [epoch for epoch, _ in unscored_checkpoints(trainer.checkpoints)] == [0, 2]
    assert read_facts(trainer.best_checkpoint)["epoch"] == 0
    row = trainer.run_epoch()
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert [r["epoch"] for r in rows if "eval/score" in r] == [0, 2, 4]
    assert row["eval/score"] == rows[-1]["eval/score"]
    assert trainer.best_score == max(r["eval/score"] for r in rows[1:] if "eval/score" in r)
    assert all(r["time/evaluation_s"] > 0 for r in rows if "eval/score" in r)
    trainer.close()


def killed(trainer: Trainer, at: int) -> None:
    """Dies after epoch `at`, with policies that wait."""
    while trainer.epoch < at:
        trainer.run_epoch()


def killed_while_scoring(trainer: Trainer, at: int) -> None:
    """Dies when it has written the row of the second policy."""
    written, count = trainer._log.write_late, []

    def write_late(row: dict, late: dict) -> None:
        written(row, late)
        count.append(row)
        if len(count) == 2:
            raise StorageFailure("gone")

    trainer._log.write_late = write_late
    killed(trainer, at)
    with pytest.raises(StorageFailure):
        trainer.score_waiting()


def stopped(trainer: Trainer, at: int) -> None:
    """Ends as a signal ends it."""
    killed(trainer, at)
    trainer.save()
    trainer.score_waiting()


@pytest.mark.parametrize("insists", [False, True])
def test_who_stops_a_trial_is_told_of_the_scores_it_waits_for(
    insists: bool, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """SIGTERM comes in epoch 3, when the policies of epochs 0 and 2 wait; a SIGINT while they are scored."""

    class Stopped(Trainer):
        def run_epoch(self) -> dict[str, float]:
            if self.epoch == 2:
                signal.raise_signal(signal.SIGTERM)
            return super().run_epoch()

        def score_waiting(self) -> None:
            if insists:
                signal.raise_signal(signal.SIGINT)
            super().score_waiting()

    made = [Stopped, Trainer]
    monkeypatch.setattr(
        training, "make_trainer", lambda config, folder, device, together: made.pop(0)(config, folder, device, 3)
    )
    config = tmp_path / "tiny.yaml"
    config.write_text(dump_yaml(tiny()))
    command = ["--config", str(config), "--device", "cpu", "--logdir", str(tmp_path / "trial")]
    assert run(main, command) == (130 if insists else 75)
    said, checkpoints = capsys.readouterr().out, tmp_path / "trial" / "checkpoints"
    assert "2 policies to score first; a second Ctrl-C leaves that to --resume" in said
    assert ("2 policies not scored yet" in said) == insists
    assert len(unscored_checkpoints(checkpoints)) == (2 if insists else 0)
    assert run(main, [*command, "--resume"]) == 0
    check_record(tmp_path / "trial", whole)


@pytest.mark.parametrize(("end", "after"), [(killed, 10), (killed_while_scoring, 10), (stopped, 1)])
def test_whatever_ends_a_trial_no_score_is_lost_or_counted_twice(
    end: Any, after: int, whole: Path, tmp_path: Path
) -> None:
    """The newest checkpoint is of epoch 4, or 5; the trial goes on with one policy or ten scored at a time."""
    first = Trainer(parse_config(tiny()), tmp_path, "cpu", 10)
    end(first, 5)
    first.close()
    second = Trainer(parse_config(tiny()), tmp_path, "cpu", after)
    assert not second.restore_latest()[1]
    while not second.finished:
        second.run_epoch()
    second.close()
    check_record(tmp_path, whole)
    lines = map(json.loads, (tmp_path / "metrics.jsonl").read_text().splitlines())
    assert [row["epoch"] for row in lines if "eval/score" in row] == [0, 2, 4, 6]


def test_training_that_fails_scores_what_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(parse_config(tiny()), tmp_path, "cpu", 10)
    killed(trainer, 5)

    def fail(epoch: int) -> None:
        raise SimulationError("nonfinite_gradient: made up", Failure.NONFINITE)

    monkeypatch.setattr(trainer.algorithm, "update", fail)
    with pytest.raises(SimulationError, match="made up"):
        trainer.run_epoch()
    trainer.close()
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert [row["epoch"] for row in rows if "eval/score" in row] == [0, 2, 4]
    assert read_facts(trainer.best_checkpoint)["best_score"] == trainer.best_score


def test_a_torn_state_is_named_and_the_others_get_their_scores(tmp_path: Path) -> None:
    first = Trainer(parse_config(tiny()), tmp_path, "cpu", 10)
    killed(first, 4)
    first.close()
    (_, torn), *_ = unscored_checkpoints(first.checkpoints)
    torn.write_bytes(torn.read_bytes()[:100])
    second = Trainer(parse_config(tiny()), tmp_path, "cpu", 10)
    (fault,) = second.restore_latest()[1]
    assert "unscored_000000.pt is torn" in fault
    assert "the policy of epoch 0 gets no score" in fault
    while not second.finished:
        second.run_epoch()
    second.close()
    assert [row["epoch"] for row in read_metrics(tmp_path / "metrics.jsonl") if "eval/score" in row] == [2, 4, 6]


def test_other_policies_leave_random_numbers_of_training_as_they_are(
    tiny_settings: dict[str, Any], tmp_path: Path
) -> None:
    """An algorithm that draws from torch's global generator, as its networks do when they are made."""
    settings = tiny() | {"algorithm": {"name": "random_search:RandomSearch", "settings": {"steps": 2}}}
    config = parse_config({k: v for k, v in settings.items() if k not in ("shac", "actor", "critic")})
    expected = train(config, tmp_path / "1", 1)
    assert comparable(train(config, tmp_path / "3", 2)) == comparable(expected)


def test_a_logger_that_takes_rows_once_has_each_policy_scored_at_once(tmp_path: Path) -> None:
    trainer = Trainer(parse_config(overlay(tiny(), {"execution.loggers": ["table_logger:Table"]})), tmp_path, "cpu", 10)
    assert "eval/score" in [trainer.run_epoch(), trainer.run_epoch()][-1]
    trainer.close()
