"""An experiment that has ended continues with more trials or more epochs; nothing it has is lost or done again."""

from pathlib import Path
from typing import Any

import pytest

from msk_ray.errors import ConfigError, StorageError
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.outcomes import Ending, Outcome, read_ending, write_ending
from msk_ray.sweep import opening
from msk_ray.sweep.extend import extended_space, parse_extension
from msk_ray.sweep.trials import resolve_trials

DRAWN = {"shac.actor_lr": {"loguniform": [1e-4, 1e-2]}}


def ended(experiment: Experiment, outcomes: list[Outcome], epoch: int = 20) -> None:
    for trial, outcome in zip(experiment.trials(), outcomes, strict=True):
        folder = experiment.trial_folder(trial.id)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "metrics.jsonl").write_text(f'{{"epoch": {epoch}, "env_steps": 1, "seconds": 1.0}}\n')
        write_ending(folder, Ending(outcome, "as it happened"))


def endings(experiment: Experiment) -> list[str | None]:
    endings = [read_ending(experiment.trial_folder(trial.id)) for trial in experiment.trials()]
    return [ending and str(ending.outcome) for ending in endings]


def test_more_epochs_wake_those_that_finished_under_their_old_ids(make_space: Any, tmp_path: Path) -> None:
    trials = resolve_trials(make_space(seeds="0-1"))
    made = opening.create(tmp_path / "e", make_space(seeds="0-1"), trials, {})
    ended(made, [Outcome.FINISHED, Outcome.STOPPED_ASHA, Outcome.NONFINITE, Outcome.FINISHED])
    opening.reopen(tmp_path / "e", trials, {"epochs": 40})
    assert [t.id for t in made.trials()] == [t.id for t in trials]
    assert {t.epochs for t in made.trials()} == {40}
    assert endings(made) == [None, "stopped_asha", "nonfinite", None]
    assert made.extension() == {"epochs": 40}
    # Resumed, or asked again, it is the same experiment; trials that reached their new end stay ended.
    ended(made, [Outcome.FINISHED] * 4, epoch=40)
    opening.reopen(tmp_path / "e", trials)
    opening.reopen(tmp_path / "e", trials, {"epochs": 40})
    assert endings(made) == ["finished"] * 4


def test_more_samples_and_seeds_come_after_the_old_trials(make_space: Any, tmp_path: Path) -> None:
    space = make_space(parameters=DRAWN, samples=2, seeds="0-1")
    trials = resolve_trials(space)
    made = opening.create(tmp_path / "e", space, trials, {})
    ended(made, [Outcome.FINISHED] * 4)
    opening.reopen(tmp_path / "e", trials, {"epochs": 30})
    ended(made, [Outcome.FINISHED] * 4, epoch=30)
    more = resolve_trials(make_space(parameters=DRAWN, samples=3, seeds="0-2"))
    opening.reopen(tmp_path / "e", more, {"samples": 3, "seeds": "0-2"})
    now = made.trials()
    assert [t.id for t in now[:4]] == [t.id for t in trials]
    assert [t.index for t in now] == list(range(9))
    assert {t.epochs for t in now} == {30}  # new ones run as long as the old
    assert endings(made) == ["finished"] * 4 + [None] * 5
    assert made.extension() == {"epochs": 30, "samples": 3, "seeds": "0-2"}


def test_an_extension_takes_nothing_away(make_space: Any, tmp_path: Path) -> None:
    space = make_space(seeds="0-1")
    trials = resolve_trials(space)
    made = opening.create(tmp_path / "e", space, trials, {})
    before = made.manifest()
    with pytest.raises(ConfigError, match=r"would drop 2 trials \(actor_lr=0\.01 seed 0, "):
        opening.reopen(tmp_path / "e", resolve_trials(make_space(seeds="1-2")), {"seeds": "1-2"})
    with pytest.raises(ConfigError, match="20 epochs already"):
        opening.reopen(tmp_path / "e", trials, {"epochs": 10})
    changed = resolve_trials(make_space(seeds="0-2", parameters={"shac.actor_lr": {"grid": [0.01, 0.002]}}))
    with pytest.raises(ConfigError, match=r"actor_lr=0\.001"):  # a changed space, under cover of an extension
        opening.reopen(tmp_path / "e", changed, {"seeds": "0-2"})
    with pytest.raises(StorageError, match="--extend adds"):  # not asked for
        opening.reopen(tmp_path / "e", resolve_trials(make_space(seeds="0-2")))
    assert made.manifest() == before


def test_epochs_that_the_space_varies_are_not_extended(make_space: Any, tmp_path: Path) -> None:
    space = make_space(parameters={"trial.epochs": {"grid": [10, 20]}})
    trials = resolve_trials(space)
    opening.create(tmp_path / "e", space, trials, {})
    with pytest.raises(ConfigError, match=r"varies trial\.epochs"):
        opening.reopen(tmp_path / "e", trials, {"epochs": 40})


def test_what_is_typed() -> None:
    assert parse_extension(["epochs=400", "seeds=0-4"]) == {"epochs": 400, "seeds": "0-4"}
    assert extended_space({"samples": 2, "base": "b"}, {"epochs": 4, "samples": 3}) == {"samples": 3, "base": "b"}
    for text, message in (
        ("400", "write epochs=N"),
        ("epochs", "write epochs=N"),
        ("epoch=400", "write epochs=N"),
        ("epochs=0", "a whole number"),
        ("epochs=x", "a whole number"),
        ("epochs=²", "a whole number"),
        ("seeds=x", "whole numbers"),
    ):
        with pytest.raises(ConfigError, match=message):
            parse_extension([text])
