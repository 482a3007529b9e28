"""A sweep without early stopping, judged afterwards: three trials small enough to follow by hand."""

import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from msk_ray.experiment.metrics import Evaluation, progress_of
from msk_ray.experiment.outcomes import Ending, Outcome
from msk_ray.experiment.results import TrialRecord
from msk_ray.experiment.snapshot import Device, State, TrialSnapshot
from msk_ray.metrics import SCORE
from msk_ray.sweep.rules.asha import Asha, SuccessiveHalving

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return runpy.run_path(str(BENCHMARKS / "early_stopping.py"))


def record(name: str, *scores: float) -> TrialRecord:
    """Evaluated after 100, 120 and 200 env steps, which take as many seconds."""
    times = (100, 120, 200)
    seen = tuple(Evaluation(t // 10, t, float(t), s) for t, s in zip(times, scores, strict=True))
    settings = SimpleNamespace(trial=SimpleNamespace(epochs=20))
    trial: Any = SimpleNamespace(id=name, variant=name, seed=0, config=settings)
    rows = tuple({"epoch": e.epoch, "env_steps": e.env_steps, "seconds": e.seconds, SCORE: e.score} for e in seen)
    snapshot = TrialSnapshot(Path(name), rows, progress_of(rows), None, None, Device(), State.STALE, None, ())
    return TrialRecord(trial, snapshot)


RECORDS = [record("late", 1.0, 1.0, 9.0), record("middle", 2.0, 2.0, 3.0), record("early", 3.0, 3.0, 4.0)]


def test_side_by_side_the_late_one_is_stopped(benchmark: dict[str, Any]) -> None:
    """At 100 it is first and alone; at 120 it is third of three, of which two continue."""
    judged = benchmark["judge"](RECORDS, SuccessiveHalving([100.0], 2.0), "env_steps", 3)
    assert [(j.record.trial.id, j.last.env_steps, j.stopped, j.best) for j in judged] == [
        ("late", 120, True, 1.0),
        ("middle", 200, False, 3.0),
        ("early", 200, False, 4.0),
    ]
    text = benchmark["table"](judged)
    assert "| late | 0 | 9 | 1 | stopped at 12 of 20 |" in text
    # 80 of 600 env steps, 8 of 60 epochs.
    assert "Saved: 13% of the env steps, 13% of the epochs. Best of all, 9: LOST, 4 instead." in text


def test_one_after_another_it_meets_nobody_at_the_rung(benchmark: dict[str, Any]) -> None:
    judged = benchmark["judge"](RECORDS, SuccessiveHalving([100.0], 2.0), "env_steps", 1)
    assert not any(j.stopped for j in judged)
    assert "Saved: 0% of the env steps, 0% of the epochs. Best of all, 9: kept." in benchmark["table"](judged)


def test_a_freed_slot_is_taken_at_once(benchmark: dict[str, Any]) -> None:
    """Two at once: `late` is stopped at 120 s only if `early` and `middle` have been at the rung by then."""
    order = [RECORDS[2], RECORDS[1], RECORDS[0]]
    judged = benchmark["judge"](order, SuccessiveHalving([100.0], 2.0), "env_steps", 2)
    # `early` and `middle` are at the rung at 100 s: one of two continues, so `middle` stops and `late` takes its place.
    assert [(j.record.trial.id, j.stopped, j.last.env_steps) for j in judged] == [
        ("early", False, 200),
        ("middle", True, 100),
        ("late", True, 100),
    ]


def test_over_all_orders(benchmark: dict[str, Any]) -> None:
    """One after another, a rung at 100 that the better half passes: `late`, the worst there, continues only if it comes
    first and meets nobody. `early` continues in any order."""
    rule = benchmark["Rule"](Asha(kind="asha", grace=0.5, reduction=2), 200.0)
    odds = benchmark["chances"](RECORDS, rule, 1, 600)
    kept = odds.kept / odds.orders
    assert odds.near == odds.kept, "nothing else comes near"
    assert kept == pytest.approx(1 / 3, abs=0.06)
    assert odds.mean_best == pytest.approx(kept * 9 + (1 - kept) * 4)
    # Least is saved by late, middle, early, where each is the best so far; most by early, late, middle.
    assert (odds.saved[0], odds.saved[2]) == pytest.approx((0.0, 200 / 600))


def test_a_twin_is_as_good(benchmark: dict[str, Any]) -> None:
    twins = [RECORDS[0], record("twin", 2.0, 2.0, 8.95), record("early", 3.0, 3.0, 4.0)]
    rule = benchmark["Rule"](Asha(kind="asha", grace=0.5, reduction=2), 200.0)
    odds = benchmark["chances"](twins, rule, 1, 600)
    # `late` continues only if it is first; the twin in all orders but `early, twin, late`, where it is worse of two.
    assert odds.kept / 600 == pytest.approx(1 / 3, abs=0.06)
    assert odds.near / 600 == pytest.approx(5 / 6, abs=0.06)


def ended(name: str, outcome: Outcome | None) -> TrialRecord:
    found = record(name, 1.0, 2.0, 3.0)
    ending = None if outcome is None else Ending(outcome, "so")
    return replace(found, snapshot=replace(found.snapshot, ending=ending))


def test_only_whole_runs_are_judged(benchmark: dict[str, Any]) -> None:
    """Those cut off by the clock may be left out; what a rule has stopped may not."""
    choose, error, folder = benchmark["choose"], benchmark["ConfigError"], Path("runs/x")
    whole, cut_off, broken = ended("a", Outcome.FINISHED), ended("b", None), ended("c", Outcome.NONFINITE)
    assert choose([whole], folder, False) == ([whole], [])
    assert choose([whole, cut_off, broken], folder, True) == ([whole], [cut_off, broken])
    with pytest.raises(error, match=r"2 of 3 .* b for one \(interrupted\); .* or --leave-out-unfinished"):
        choose([whole, cut_off, broken], folder, False)
    with pytest.raises(error, match=r"2 of 3 .* s for one \(stopped_asha\); .*--no-early-stopping$"):
        choose([whole, cut_off, ended("s", Outcome.STOPPED_ASHA)], folder, True)
    with pytest.raises(error, match=r"1 of 1 .*--no-early-stopping$"):
        choose([cut_off], folder, True)


def test_a_sweep_that_was_stopped_early_is_refused(
    benchmark: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "manifest.json").write_text('{"format": 1, "name": "x", "question": "", "trials": []}')
    assert benchmark["run"](benchmark["main"], [str(tmp_path)]) != 0
    assert "judge a finished sweep that ran with --no-early-stopping" in capsys.readouterr().err
