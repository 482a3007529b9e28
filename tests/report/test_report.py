"""The report of experiments in every condition, and what its tables and curves say."""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msk_ray.cli import run
from msk_ray.config import dump_yaml
from msk_ray.errors import ConfigError
from msk_ray.experiment import snapshot
from msk_ray.experiment.attempts import Attempt, WorldReduction
from msk_ray.experiment.damage import DamagedFile
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.notes import load_notes, write_note
from msk_ray.experiment.outcomes import Ending, Outcome, write_ending
from msk_ray.experiment.records import ExperimentReader, TrialRecord
from msk_ray.report.__main__ import main
from msk_ray.report.charts import Floor, Picture, Plot, thin_evenly
from msk_ray.report.curves import curve_over, learning_curves, rung_steps
from msk_ray.report.effects import ranked_effects
from msk_ray.report.page import _templates, make_section, places_of
from msk_ray.report.reading import Condition, read_again, read_experiment
from msk_ray.report.tables import compare_variants, failures, outcome_figures
from msk_ray.sweep import opening
from msk_ray.sweep.space import parse_space
from msk_ray.sweep.trials import base_settings, make_trial, resolve_trials

pytestmark = pytest.mark.long


def row(epoch: int, score: float | None = None) -> dict[str, Any]:
    base = {"epoch": epoch, "env_steps": 100 * epoch, "seconds": 2.0 * epoch, "env_steps_per_s": 50.0}
    grad = {"grad/actor_norm": 1.0 + epoch, "grad/nonfinite_share": 0.0} if epoch else {}
    return base | grad | ({} if score is None else {"eval/score": score, "eval/vx": score / 10, "eval/length": 7.0})


def fill(folder: Path, scores: list[float], ending: Ending | None = None) -> None:
    """A trial's folder with an evaluation every second epoch."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [row(epoch, scores[epoch // 2] if epoch % 2 == 0 else None) for epoch in range(2 * len(scores) - 1)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
    if ending is not None:
        write_ending(folder, ending)


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    """A baseline and two variants, two seeds each, all finished but the last, which failed."""
    (tmp_path / "base.yaml").write_text(dump_yaml({"env": {"name": "cartpole"}, "trial": {"epochs": 4}}))
    data = {
        "question": "Does <b>it</b> matter?",
        "base": "base.yaml",
        "ablate": {"variants": {"fast": {"shac.actor_lr": 0.1}, "deep": {"actor.hidden": [9, 9]}}},
        "seeds": "0-1",
    }
    space = parse_space(data, tmp_path / "small.yaml")
    trials = resolve_trials(space)
    made = opening.create(tmp_path / "runs" / "e", space, trials, {})
    scores = {("baseline", 0): 10.0, ("baseline", 1): 12.0, ("fast", 0): 30.0, ("fast", 1): 34.0, ("deep", 0): 11.0}
    for trial in trials:
        score = scores.get((trial.changed["variant"], trial.seed))
        folder = made.trial_folder(trial.id)
        if score is None:
            fill(folder, [1.0, 2.0], Ending(Outcome.NONFINITE, "train/actor_loss is nan <i>at</i> epoch 3"))
            (folder / "output.log").write_text("line\n" * 30 + "the last words\n")
        else:
            fill(folder, [0.0, score, score - 1], Ending(Outcome.FINISHED, "all 4 epochs done"))
    return made


def page_of(experiment: Experiment, *arguments: str) -> str:
    assert run(main, [str(experiment.path), *arguments]) == 0
    return (experiment.path / "report" / "index.html").read_text()


def test_tables_by_hand(experiment: Experiment) -> None:
    reading = read_experiment(experiment, time.time())
    assert reading.condition is Condition.FINISHED
    assert reading.warnings == ()
    rows = compare_variants(reading, "baseline")
    assert [(r.variant, r.mean, r.difference, r.verdict) for r in rows] == [
        ("fast", 32.0, 21.0, "better"),
        ("baseline", 11.0, None, "baseline"),
        ("deep", 6.5, -4.5, "unclear"),
    ]
    assert rows[0].figures == {"vx": 3.2}
    (failure,) = failures(reading)
    assert (failure[0], len(failure[2])) == ("nonfinite", 1)
    assert failure[2][0].tail().splitlines()[-1] == "the last words"
    best = reading.best
    assert best is not None
    assert (best.score, best.best_row["epoch"]) == (34.0, 2.0)


def test_stopped_trials_are_compared_where_they_stopped(experiment: Experiment) -> None:
    """`fast` is far behind whole runs because it was stopped; where it was stopped it was ahead."""
    rising = {0: [0.0, 4.0, 50.0], 1: [0.0, 6.0, 70.0]}
    for trial in experiment.trials():
        if trial.changed["variant"] == "baseline":
            fill(experiment.trial_folder(trial.id), rising[trial.seed])
        elif trial.changed["variant"] == "fast":
            fill(experiment.trial_folder(trial.id), [0.0, 7.0 + trial.seed], Ending(Outcome.STOPPED_ASHA, "behind"))
    reading = read_experiment(experiment, time.time())
    rows = {row.variant: row for row in compare_variants(reading, "baseline")}
    fast, deep = rows["fast"], rows["deep"]
    assert (fast.mean, fast.cut, rows["baseline"].mean) == (7.5, 2, 60.0)
    # At 200 env steps: (7 + 8)/2 against (4 + 6)/2; the bootstrap's extremes are 7 - 6 and 8 - 4.
    assert (fast.compared_at, fast.difference, fast.verdict) == (200.0, 2.5, "better so far")
    # All of `deep` ended by itself, finished or failed: whole runs are compared.
    assert (deep.compared_at, deep.difference) == (None, 6.5 - 60.0)
    page = page_of(experiment)
    assert "2 of 2 (2 before the end)" in page
    assert "compared at" in page
    assert "Open circles are trials that were stopped before their end" in page


def compared(made: Experiment, curves: dict[str, list[tuple[int, float]]], outcome: Outcome) -> Any:
    """The row of `fast`, stopped with this outcome, beside whole runs of the baseline: one seed counts of each."""
    for trial in made.trials():
        name = trial.changed["variant"]
        if name not in curves or trial.seed:
            (made.trial_folder(trial.id) / "metrics.jsonl").unlink(missing_ok=True)
            continue
        rows = [row(epoch, score) for epoch, score in curves[name]]
        (made.trial_folder(trial.id) / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
        if name == "fast":
            write_ending(made.trial_folder(trial.id), Ending(outcome, "so"))
    rows_now = compare_variants(read_experiment(made, time.time()), "baseline")
    return next(r for r in rows_now if r.variant == "fast")


def test_nobody_is_compared_with_an_untrained_policy(experiment: Experiment) -> None:
    """At its first evaluation the baseline was elsewhere: at epoch 6, where `fast` no longer was."""
    stopped = Outcome.STOPPED_ASHA
    fast = compared(experiment, {"baseline": [(0, 0.0), (6, 90.0)], "fast": [(0, 0.0), (4, 50.0)]}, stopped)
    assert (fast.mean, fast.difference, fast.verdict) == (50.0, None, "not comparable")
    fast = compared(experiment, {"baseline": [(0, 0.0), (6, 90.0)], "fast": [(0, 50.0)]}, stopped)
    assert (fast.mean, fast.cut, fast.verdict) == (None, 0, "no score")
    assert "compared at" not in page_of(experiment)


def test_nothing_is_told_from_untrained_policies(experiment: Experiment) -> None:
    """Two variants were stopped before they were evaluated: from their untrained scores ω² would be 1."""
    for trial in experiment.trials():
        if trial.changed["variant"] != "baseline":
            fill(experiment.trial_folder(trial.id), [-9145.6], Ending(Outcome.STOPPED_ASHA, "behind"))
    reading = read_experiment(experiment, time.time())
    assert [trial.score for trial in reading.trials if trial.ending and trial.ending.cut] == [None] * 4
    effects = {effect.factor: effect for effect in ranked_effects(reading, places_of([reading]))}
    variant = effects["variant"]
    assert (variant.share, variant.spread, variant.too_few) == (None, None, "fast has none, and 1 more")
    rows = {row.variant: row for row in compare_variants(reading, "baseline")}
    assert [(rows[v].mean, rows[v].difference, rows[v].verdict) for v in ("fast", "deep")] == [
        (None, None, "no score")
    ] * 2
    page = page_of(experiment)
    assert "9145" not in page.replace("\N{MINUS SIGN}", "-")
    assert "needs 2 at each level: seed (0 has 1, and 1 more), variant (fast has none, and 1 more)." in page


def test_evaluations_at_other_env_steps_are_compared_at_the_newest_common_ones(
    experiment: Experiment,
) -> None:
    """`fast` was stopped at epoch 5; the baseline was evaluated at 4 before that, where `fast` had been at 3."""
    baseline, fast = [(0, 0.0), (4, 40.0), (8, 80.0)], [(0, 0.0), (3, 35.0), (5, 55.0)]
    row = compared(experiment, {"baseline": baseline, "fast": fast}, Outcome.STOPPED_ASHA)
    assert (row.compared_at, row.difference) == (400.0, 35.0 - 40.0)


def test_what_used_up_its_time_is_a_whole_run(experiment: Experiment) -> None:
    curves = {"baseline": [(0, 0.0), (4, 40.0), (8, 80.0)], "fast": [(0, 0.0), (4, 50.0)]}
    row = compared(experiment, curves, Outcome.WALL_TIME)
    assert (row.compared_at, row.difference, row.cut) == (None, 50.0 - 80.0, 0)


def test_the_page_says_it_all_and_takes_nothing_for_markup(experiment: Experiment) -> None:
    page = page_of(experiment)
    assert "Does &lt;b&gt;it&lt;/b&gt; matter?" in page
    assert "nan &lt;i&gt;at&lt;/i&gt; epoch 3" in page
    for words in ("6 trials: 5 finished, 1 nonfinite", "Differences are from: baseline", "the last words", "better"):
        assert words in page
    assert "compared at" not in page, "nothing was cut short"
    assert "Open circles" not in page
    assert "There is no policy to look at" in page  # these trials have no checkpoints
    assert "http" not in page.replace("http-equiv", ""), "nothing is fetched"
    for name in ("curves", "effects", "parallel", "stops", "health"):
        assert f'data-figure="{name}"' in page


def test_outcomes_are_looked_for_once_and_not_for_each_variant(
    experiment: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[int] = []

    def counted(trials: Sequence[TrialRecord]) -> list[str]:
        looks.append(len(trials))
        return outcome_figures(trials)

    monkeypatch.setitem(_templates().globals, "outcome_figures", counted)
    page_of(experiment, "--best", "never")
    assert len(looks) == 1


def test_an_axis_says_what_leaves_it(experiment: Experiment) -> None:
    """Policies that fall apart would press all other curves together at the top."""
    reading = read_experiment(experiment, time.time())
    places = places_of([reading])
    assert floor_of(learning_curves(reading.variants, None, "x", places)) is None
    fill(reading.trials[0].folder, [0.0, 34.0, -5000.0], Ending(Outcome.FINISHED, "all 4 epochs done"))
    # First and best scores lie between 0 and 34: a tenth of that is left below them.
    cut = learning_curves(read_experiment(experiment, time.time()).variants, None, "x", places)
    assert floor_of(cut) == Floor(-3.4, "▼ 1 trial goes below this axis, down to -5000")
    fill(reading.trials[0].folder, [0.0, 34.0, -10.0], Ending(Outcome.FINISHED, "all 4 epochs done"))
    near = learning_curves(read_experiment(experiment, time.time()).variants, None, "x", places)
    assert floor_of(near) is None, "little is won by cutting off what is near"


def floor_of(picture: Picture | None) -> Floor | None:
    assert picture is not None
    (plot,) = picture.chart.panels
    assert isinstance(plot, Plot)
    return plot.y.floor


def test_charts_have_the_numbers_of_their_trials(experiment: Experiment) -> None:
    reading = read_experiment(experiment, time.time())
    section = make_section(reading, experiment.path / "report", "", None, places_of([reading]))
    charts: Any = {name: picture.chart for name, picture in section.pictures.items()}
    (curves,) = charts["curves"].panels
    names = [style.name for style in charts["curves"].styles]
    (fast,) = [line for line in curves.lines if names[line.style] == "fast" and line.when == "unfiltered"]
    assert (fast.x, fast.y) == ([0.0, 200.0, 400.0], [0.0, 32.0, 31.0])
    assert (fast.low, fast.high) == ([0.0, 30.0, 29.0], [0.0, 34.0, 33.0])
    lines = {line.trial: line for line in curves.lines}
    ids = [trial.trial.id for trial in reading.trials]
    second = next(t for t in reading.trials if (t.trial.variant, t.trial.seed) == ("fast", 1))
    own = lines[ids.index(second.trial.id)]
    assert (own.x, own.y, own.when) == ([0.0, 200.0, 400.0], [0.0, 34.0, 33.0], "filtered")
    (cross,) = curves.points
    assert (names[cross.style], cross.x, cross.y, cross.trial) == ("deep", 200.0, 2.0, 5), "the trial that failed"
    ranking, levels, *_ = charts["effects"].panels
    assert [row.label for row in ranking.rows] == ["variant", "seed"]
    place = levels.x.labels.index("fast")
    at_fast = [point for point in levels.points if abs(point.x - place) < 0.5]
    assert [point.y for point in at_fast if point.trial is None] == [32.0]
    assert [(point.y, point.hollow) for point in at_fast if point.trial is not None] == [(30.0, False), (34.0, False)]
    (parallel,) = charts["parallel"].panels
    assert parallel.axes[0].labels == ("baseline", "fast", "deep")
    assert {line.trial: line.values for line in parallel.lines}[ids.index(second.trial.id)] == [1.0, 34.0]
    (stops,) = charts["stops"].panels
    assert [row.value for row in stops.rows] == [400.0] * 5 + [200.0]
    assert [charts["stops"].styles[row.style].name for row in stops.rows] == ["finished"] * 5 + ["nonfinite"]


def test_a_long_curve_keeps_its_ends_and_extremes() -> None:
    y = np.zeros(1000)
    y[400], y[700] = 5.0, -5.0
    x, thin = thin_evenly(np.arange(1000.0), y, 10)
    assert (x[0], x[-1], len(x)) == (0.0, 999.0, 12)
    assert (thin.max(), thin.min()) == (5.0, -5.0)


def test_only_what_has_changed_is_read_again(experiment: Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = ExperimentReader(experiment)
    before = read_again(reader, time.time())
    read: list[Path] = []
    load = snapshot.load_metrics
    monkeypatch.setattr(snapshot, "load_metrics", lambda path: read.append(path) or load(path))
    monkeypatch.setattr(Experiment, "trials", lambda _: pytest.fail("its manifest has not changed"))
    changed = before.trials[2].folder
    fill(changed, [0.0, 99.0], Ending(Outcome.FINISHED, "done"))
    write_note(experiment.path, before.trials[3].trial.id, "  look at this\n")
    after = read_again(reader, time.time())
    assert read == [changed / "metrics.jsonl"]
    assert (after.trials[2].score, after.trials[3].note) == (99.0, "look at this")
    assert [a is b for a, b in zip(before.trials, after.trials, strict=True)] == [True] * 2 + [False] * 2 + [True] * 2
    monkeypatch.undo()
    assert '<td class="wide note">look at this</td>' in page_of(experiment)


def test_notes_are_removed_when_empty_and_never_written_over_what_is_not_understood(experiment: Experiment) -> None:
    write_note(experiment.path, "a", "first")
    write_note(experiment.path, "b", "second")
    write_note(experiment.path, "a", " ")
    assert load_notes(experiment.path) == {"b": "second"}
    with pytest.raises(ConfigError, match="at most 2000 characters"):
        write_note(experiment.path, "b", "x" * 2001)
    (experiment.path / "notes.json").write_text('{"trials": 3}')
    with pytest.raises(DamagedFile, match="trials is a whole number"):
        write_note(experiment.path, "b", "third")
    assert "notes.json: trials is a whole number" in page_of(experiment)


def test_half_the_worlds_are_said_wherever_a_score_is(experiment: Experiment) -> None:
    assert "half the worlds" not in page_of(experiment)
    best = read_experiment(experiment, time.time()).best
    assert best is not None
    Attempt(WorldReduction(64, 32, "no room", cleared=True)).write(best.folder)
    page = " ".join(page_of(experiment).split())
    note = f"with half the requested worlds, after running out of memory with all of them (<code>{best.trial.id}<"
    assert note in page
    assert "fast, seed 1, half the worlds: 32 of 64</dd>" in page
    assert ">2 of 2 (1 with half the worlds)</td>" in page
    assert "<td>finished, half the worlds</td>" in page
    assert "half the worlds: 32 of 64; all 4 epochs done</td>" in page


def test_trials_that_could_be_faster_are_named_first(experiment: Experiment) -> None:
    trial = experiment.trials()[0]
    rows = [row(epoch) | {"train/recorded": 0.0, "train/unrecordable": float(epoch > 1)} for epoch in range(1, 4)]
    path = experiment.trial_folder(trial.id) / "metrics.jsonl"
    path.write_text("".join(json.dumps(r) + "\n" for r in rows))
    (warning,) = read_experiment(experiment, time.time()).warnings
    assert warning == (
        f"Epochs of {trial.id} could not be recorded as graphs, and took two to three times as long: their output.log "
        "says why."
    )
    assert warning in page_of(experiment)
    path.write_text("".join(json.dumps(r | {"train/unrecordable": 0.0}) + "\n" for r in rows))
    assert not read_experiment(experiment, time.time()).warnings


def test_the_baseline_can_be_chosen(experiment: Experiment, capsys: pytest.CaptureFixture[str]) -> None:
    assert "Differences are from: fast" in page_of(experiment, "--baseline", "fas")
    assert run(main, [str(experiment.path), "--baseline", "slow"]) == 2
    assert "no variant of e has this name; write one of: baseline; fast; deep" in capsys.readouterr().err


def test_command_and_files(experiment: Experiment) -> None:
    env = {"command": ["/x/y/msk_ray/tune/__main__.py", "--space", "a b"], "commit": "abc+", "packages": {"torch": "1"}}
    env |= {"gpus": ["A", "B"], "driver": "570"}
    (experiment.path / "env.json").write_text(json.dumps(env))
    page = page_of(experiment)
    assert "git checkout abc\npython -m msk_ray.tune --space &#39;a b&#39;" in page
    assert "changes that were not committed" in page
    assert "<dt>GPUs there:</dt> <dd>A, B (driver 570)</dd>" in page
    reading = read_experiment(experiment, 0.0)
    section = make_section(reading, experiment.path / "report", "", None, places_of([reading]))
    links = [link for trial in section.reading.trials for _, link in section.files(trial)]
    assert len(links) == 7  # six metrics and an output
    assert all((experiment.path / "report" / link).is_file() for link in links)


def _empty(e: Experiment) -> None:
    shutil.rmtree(e.path)
    e.path.mkdir()


def _half_written(e: Experiment) -> None:
    (e.path / "manifest.json").unlink()
    shutil.rmtree(e.path / "trials")


def _torn_manifest(e: Experiment) -> None:
    path = e.path / "manifest.json"
    path.write_text(path.read_text()[:200])
    # What trials wrote themselves is still found.
    for trial_folder in (e.path / "trials").iterdir():
        (trial_folder / "config.yaml").write_text(dump_yaml({"env": {"name": "cartpole"}}))


def _nothing_else(e: Experiment) -> None:
    (e.path / "env.json").unlink()
    (e.path / "space.yaml").write_text("question: [")


def _not_begun(e: Experiment) -> None:
    for folder in (e.path / "trials").iterdir():
        shutil.rmtree(folder)


def _folders(e: Experiment) -> list[Path]:
    return [e.trial_folder(trial.id) for trial in e.trials()]


def _broken_trials(e: Experiment) -> None:
    folders = _folders(e)
    (folders[0] / "metrics.jsonl").write_text('{"epoch": 0, "ev\n{"epoch": 1}\n')
    (folders[1] / "outcome.json").write_text('{"outcome": "fin')
    (folders[2] / "metrics.jsonl").write_text('{"epoch": 0, "env_steps": 0}\n{"epoch": 1, "env')
    (folders[3] / "metrics.jsonl").write_text("")
    (folders[4] / "outcome.json").write_text('{"outcome": "unheard_of", "why": ""}')


def _crashed(e: Experiment) -> None:
    for folder in _folders(e)[:3]:
        (folder / "outcome.json").unlink()
        os.utime(folder / "metrics.jsonl", (1e9, 1e9))


def _running(e: Experiment) -> None:
    (_folders(e)[0] / "outcome.json").unlink()


def _never_evaluated(e: Experiment) -> None:
    for folder in _folders(e):
        rows = [row(1), row(2)]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))


def _nothing_finite(e: Experiment) -> None:
    bad = {"epoch": 1, "env_steps": 5, "seconds": 1.0, "eval/score": None, "grad/actor_norm": None}
    for folder in _folders(e):
        (folder / "metrics.jsonl").write_text(json.dumps(bad | {"nonfinite": ["eval/score", "grad/actor_norm"]}) + "\n")


def _best_without_policy(e: Experiment) -> None:
    for folder in _folders(e):
        (folder / "checkpoints").mkdir()
        (folder / "checkpoints" / "best.pt").write_bytes(b"torn")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_empty, ["The folder is empty.", "empty"]),
        (_half_written, ["Which trials were planned is not known", "manifest.json is missing", "It has no trials"]),
        (_torn_manifest, ["Which trials were planned is not known", "6 trials"]),
        (_nothing_else, ["env.json is missing", "space.yaml cannot be read", "Versions and command were not recorded"]),
        (_not_begun, ["not started", "No trial has started yet", "No trained policy has a score yet"]),
        (
            _broken_trials,
            ["Skipped: 1 damaged line and 2 damaged files.", "line 1: not JSON", "unheard_of", "3 finished"],
        ),
        (_crashed, ["interrupted", "with --resume, continues it", "3 interrupted"]),
        (_running, ["Trials are still running", "1 running"]),
        (_never_evaluated, ["No trained policy has a score yet", "Too few trained trials with a score"]),
        (_nothing_finite, ["No trained policy has a score yet", "No trial has recorded a gradient yet"]),
        (_best_without_policy, ["is torn: it has no head"]),
    ],
)
def test_every_condition_is_named_and_never_a_traceback(
    experiment: Experiment, damage: Any, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    damage(experiment)
    page = page_of(experiment)
    for expected in words:
        assert expected in page
    assert "Traceback" not in page
    assert capsys.readouterr().err == ""


def test_several_side_by_side(experiment: Experiment, tmp_path: Path) -> None:
    other = Experiment(Path(shutil.copytree(experiment.path, tmp_path / "runs" / "other")))
    _crashed(other)
    out = tmp_path / "both"
    assert run(main, ["e", "other", "--storage", str(tmp_path / "runs"), "--out", str(out)]) == 0
    page = (out / "index.html").read_text()
    assert f"python -m msk_ray.report e other --storage {tmp_path / 'runs'}<" in page
    assert "Side by side" in page
    assert page.count('<section id="') == 3
    for name in ("together", "1_curves", "2_curves"):
        assert f'data-figure="{name}"' in page
    assert not (experiment.path / "report").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["e", "e"], "the same experiment twice"),
        (["x"], "did you mean 'e'?"),
        (["../base.yaml"], "is not a checkpoint"),
        (["../elsewhere"], "holds no experiment"),
    ],
)
def test_bad_input_is_one_line(
    experiment: Experiment,
    tmp_path: Path,
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "letter.txt").touch()
    if message == "did you mean 'e'?":
        arguments = ["ee"]
    assert run(main, [*arguments, "--storage", str(experiment.path.parent)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_rungs_of_a_search_are_drawn_where_trials_were_judged(tmp_path: Path) -> None:
    """Whatever it has suggested so far: here only its shortest trial."""
    (tmp_path / "base.yaml").write_text(dump_yaml({"env": {"name": "cartpole", "nworld": 8}, "trial": {"epochs": 20}}))
    data = {
        "question": "?",
        "base": str(tmp_path / "base.yaml"),
        "search": "optuna",
        "parameters": {"shac.horizon": {"choice": [4, 32]}},
        "scheduler": {"kind": "asha", "grace": 0.25, "reduction": 2},
    }
    space = parse_space(data, tmp_path / "search.yaml")
    made = opening.create(tmp_path / "runs" / "search", space, [], {})
    made.set_trials([make_trial(space, base_settings(space), {"shac.horizon": "4"}, {"shac.horizon": 4}, 0, 0)])
    assert rung_steps(read_experiment(made, time.time())) == ([1280.0, 2560.0], "")
    (tmp_path / "base.yaml").unlink()
    steps, unknown = rung_steps(read_experiment(made, time.time()))
    assert steps == []
    assert "is not known" in unknown
    assert "no such config file" in unknown


@pytest.mark.parametrize("several", [True, False])
def test_several_algorithms_are_compared_over_seconds_too(several: bool, tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(dump_yaml({"env": {"name": "cartpole"}, "trial": {"epochs": 4}}))
    name, levels = ("algorithm.name", ["shac", "ppo"]) if several else ("shac.gamma", [0.9, 0.8])
    data = {"question": "?", "base": "base.yaml", "parameters": {name: {"grid": levels}}}
    space = parse_space(data, tmp_path / "two.yaml")
    made = opening.create(tmp_path / "runs" / "two", space, resolve_trials(space), {})
    for trial in made.trials():
        fill(made.trial_folder(trial.id), [1.0, 2.0, 3.0], Ending(Outcome.FINISHED, "all 4 epochs done"))
    page = page_of(made)
    assert ("algorithm=ppo" in page) == several
    assert ("Evaluation score over seconds of training of 2 variants" in page) == several
    assert ('data-figure="times"' in page) == several
    reading = read_experiment(made, time.time())
    assert [list(x) for x in curve_over(reading.trials[0], "seconds")] == [[0.0, 4.0, 8.0], [1.0, 2.0, 3.0]]


def test_it_says_which_variants_were_trained_with_drawn_parameters(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(dump_yaml({"env": {"name": "cartpole"}, "trial": {"epochs": 4}}))
    masses = {"body_mass": {"low": 0.5, "high": 2.0}}
    data = {"question": "?", "base": "base.yaml", "parameters": {"physics.randomize": {"grid": [None, masses]}}}
    space = parse_space(data, tmp_path / "small.yaml")
    trials = resolve_trials(space)
    made = opening.create(tmp_path / "runs" / "e", space, trials, {})
    for trial in trials:
        fill(made.trial_folder(trial.id), [0.0, 1.0], Ending(Outcome.FINISHED, "done"))
    page = page_of(made)
    assert "1 of 2 variants are trained with body_mass ×0.5 to ×2, drawn for every episode" in page
    assert "every score is of the model as it is" in page


def test_the_bundled_library_is_the_documented_one(root: Path) -> None:
    folder = root / "msk_ray" / "report" / "page" / "echarts"
    digest = hashlib.sha256((folder / "echarts.min.js").read_bytes()).hexdigest()
    assert digest in (folder / "README.md").read_text()
