"""Evaluations: the canonical score again, the same twice, every figure by hand, and inputs one may get wrong."""

import argparse
import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from disturbed import DISTURBANCES

from msk_ray.cli import positive, run
from msk_ray.config import overlay, parse_config
from msk_ray.errors import CheckpointError
from msk_ray.evaluate.__main__ import main
from msk_ray.evaluate.measure import Bench, Request, figures
from msk_ray.evaluate.stored import read_evaluations, store_evaluation
from msk_ray.experiment.attempts import Attempt, WorldReduction
from msk_ray.experiment.manifest import Experiment
from msk_ray.experiment.records import best_records, read_records
from msk_ray.training import Trainer, load_policy, read_metrics
from msk_ray.training.checkpoint import milestones
from msk_ray.training.evaluation_tally import Episodes


@pytest.fixture
def trial(sweep: Experiment, tmp_path: Path) -> Path:
    """A copy of the best trial's folder."""
    best = best_records(read_records(sweep)).get("cartpole")
    assert best is not None
    return Path(shutil.copytree(best.folder, tmp_path / "trial"))


def entries(folder: Path) -> list[dict[str, Any]]:
    return read_evaluations(folder / "eval.json")


def test_evaluation_repeats_the_score_that_ranks_trials(trial: Path) -> None:
    assert run(main, [str(trial), "--device", "cpu"]) == 0
    (first,) = entries(trial)
    assert run(main, [str(trial / "checkpoints" / "best.pt"), "--device", "cpu"]) == 0
    (second,) = entries(trial)  # in place of the first: same checkpoint, physics and size
    timeless = lambda entry: {k: v for k, v in entry.items() if k != "date"}  # noqa: E731
    assert timeless(first) == timeless(second)
    rows = [row for row in read_metrics(trial / "metrics.jsonl") if "eval/score" in row and row["epoch"] > 0]
    best = max(rows, key=lambda row: row["eval/score"])
    assert first["canonical"]
    assert first["score"]["mean"] == best["eval/score"]
    assert first["score"]["std"] == best["eval/score_std"]
    assert first["outcomes"]["upright"]["mean"] == best["eval/upright"]
    assert {f"eval/term/{k}": v["mean"] for k, v in first["terms"].items()} == {
        k: v for k, v in best.items() if k.startswith("eval/term/")
    }
    assert math.isclose(sum(v["mean"] for v in first["terms"].values()), first["score"]["mean"], rel_tol=1e-5)


def test_a_policy_can_be_scored_under_what_disturbed_it_in_training(
    tiny_settings: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer = Trainer(parse_config(overlay(tiny_settings, {"physics.randomize": DISTURBANCES})), tmp_path, "cpu")
    trainer.run_epoch()
    trainer.close()
    command = [str(tmp_path / "checkpoints" / "policy_000000.pt"), "--device", "cpu", "--with"]
    assert run(main, [*command, "push,disturbed"]) == 2
    assert "--with push: a trial of env cartpole has disturbed; write" in capsys.readouterr().err
    assert not (tmp_path / "eval.json").exists(), "refused before the first step"
    scores = []
    for _ in range(2):
        assert run(main, [*command, "disturbed"]) == 0
        clean, disturbed = sorted(entries(tmp_path), key=lambda entry: str(entry["physics"]))
        scores.append(disturbed["scores"])
        assert (clean["physics"], disturbed["physics"]) == ("own", "own, disturbed")
        assert clean["canonical"]
        assert not disturbed["canonical"]
        assert clean["scores"] != disturbed["scores"]
    assert scores[0] == scores[1], "the same is drawn again"
    assert re.search(r"length +fell +upright", capsys.readouterr().out)


def test_a_trial_without_disturbances_or_conditions_is_not_scored_under_any(
    trial: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (trial / "eval.json").unlink(missing_ok=True)
    assert run(main, [str(trial), "--device", "cpu", "--with", "disturbed"]) == 2
    assert "--with disturbed: a trial of env cartpole has none; leave it out" in capsys.readouterr().err
    assert not (trial / "eval.json").exists()


def test_seeds_worlds_and_steps_can_be_chosen(trial: Path) -> None:
    assert run(main, [str(trial), "--seeds", "1,2", "--worlds", "3", "--steps", "10", "--device", "cpu"]) == 0
    (entry,) = entries(trial)
    assert not entry["canonical"]
    assert len(entry["scores"]) == 6
    assert entry["length"] == {"mean": 10.0, "std": 0.0, "min": 10.0, "max": 10.0}
    by_seed = entry["score_by_seed"]
    assert by_seed["1"] != by_seed["2"]
    assert math.isclose((by_seed["1"] + by_seed["2"]) / 2, entry["score"]["mean"], rel_tol=1e-6)


def test_an_untrained_policy_has_no_rank(sweep: Experiment, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path(shutil.copytree(sweep.path, tmp_path / "small"))
    untrained = folder / "trials" / sweep.trials()[1].id / "checkpoints"
    shutil.copy(untrained / "policy_000000.pt", untrained / "best.pt")
    assert run(main, ["small", "--storage", str(tmp_path), "--device", "cpu"]) == 0
    data = json.loads((folder / "eval.json").read_text())
    assert data["untrained"] == [sweep.trials()[1].id]
    assert len(data["rankings"][0]["ranking"]) == 3
    assert "is the untrained policy; it has no rank" in capsys.readouterr().out
    assert run(main, [str(untrained.parent), "--device", "cpu"]) == 0
    assert "epoch 0 (untrained), under" in capsys.readouterr().out


def test_an_experiment_is_ranked_and_a_torn_policy_is_named(
    sweep: Experiment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(sweep.path, tmp_path / "small"))
    torn = Experiment(folder).trials()[1].id
    with (folder / "trials" / torn / "checkpoints" / "best.pt").open("ab") as file:
        file.write(b"x")
    Attempt(WorldReduction(16, 8, "no room", cleared=True)).write(folder / "trials" / Experiment(folder).trials()[0].id)
    assert run(main, ["small", "--storage", str(tmp_path), "--device", "cpu"]) == 1
    data = json.loads((folder / "eval.json").read_text())
    (ranked,) = data["rankings"]
    scores = [entry["score"]["mean"] for entry in ranked["ranking"]]
    assert len(scores) == 3
    assert scores == sorted(scores, reverse=True)
    recorded = {record.trial.id: record.best.score for record in read_records(sweep) if record.best is not None}
    assert {e["trial"]: e["score"]["mean"] for e in ranked["ranking"]} == {
        k: v for k, v in recorded.items() if k != torn
    }
    assert [entry["trial"] for entry in data["failed"]] == [torn]
    assert "is torn" in data["failed"][0]["why"]
    shown = capsys.readouterr().out
    assert "under own physics" in shown
    assert shown.count("(half the worlds: 8 of 16)") == 1


def test_vary_evaluates_other_values_of_a_parameter(trial: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = ["--steps", "20", "--device", "cpu"]
    assert run(main, [str(trial), "--vary", "jnt_stiffness=2x", *short]) == 2
    assert entries(trial) == [], "refused before anything is run"
    assert run(main, [str(trial), "--vary", "body_mass=1x,3x", *short]) == 0
    own, once, thrice = entries(trial)
    assert [e["physics"] for e in (own, once, thrice)] == ["own", "own, body_mass ×1", "own, body_mass ×3"]
    assert not once["canonical"]
    assert once["scores"] == pytest.approx(own["scores"], rel=1e-5)
    assert abs(thrice["score"]["mean"] - own["score"]["mean"]) > 1e-2
    shown = capsys.readouterr().out
    assert "of its own" in shown
    assert "own, body_mass ×3" in shown
    for text, why in {
        "body_mas=2x": "write FIELD=VALUE,VALUE with one of geom_friction",
        "body_mass=2": "only multiples of the model's own; write 2x",
        "dof_damping=0.1,hot": "is no positive number; write 0.8, or 0.8x",
        "geom_friction=nan": "is no positive number",
        "jnt_stiffness=2x": "--vary jnt_stiffness: it is 0 in the model",
    }.items():
        assert run(main, [str(trial), "--vary", text, *short]) == 2
        assert why in capsys.readouterr().err.splitlines()[-1]


def test_an_experiment_is_ranked_under_each_value(
    sweep: Experiment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(sweep.path, tmp_path / "small")
    common = ["small", "--storage", str(tmp_path), "--steps", "5", "--worlds", "2", "--device", "cpu"]
    assert run(main, [*common, "--vary", "pair_friction=2x"]) == 2
    assert "--vary pair_friction: the model has no pair" in capsys.readouterr().err
    assert run(main, [*common, "--vary", "body_mass=3x"]) == 0
    rankings = json.loads((tmp_path / "small" / "eval.json").read_text())["rankings"]
    assert [ranking["physics"] for ranking in rankings] == ["own", "own, body_mass ×3"]
    assert all(len(ranking["ranking"]) == 4 for ranking in rankings)


def test_physics_can_be_named(ant_trial: Path) -> None:
    policy = load_policy(ant_trial / "checkpoints" / "best.pt")
    bench = Bench("cpu")
    reference, published, own = (
        bench.evaluate(policy, Request(name, steps=20)) for name in ("reference", "published", "own")
    )
    assert [e["physics"] for e in (reference, published, own)] == ["matched", "published", "own"]
    assert reference["score"]["mean"] != published["score"]["mean"]
    assert reference["score"] == own["score"]  # this trial trains on the reference physics as it stands
    assert set(reference["terms"]) == {"forward_vel", "up", "heading", "height", "action"}
    assert "vx" in reference["outcomes"]


def test_trials_share_a_simulation_unless_one_adds_up_in_a_fixed_order(tiny_settings: dict[str, Any]) -> None:
    bench = Bench("cpu")
    changes = [{}, {"trial": {"seed": 1}}, {"execution": {"deterministic": True}}]
    one, other, ordered = (bench.evaluator(parse_config({**tiny_settings, **c}), Request())[0] for c in changes)
    assert one is other
    assert ordered is not one
    assert ordered.env.sim.batch.ordered


def test_figures_match_those_worked_out_by_hand() -> None:
    flags = torch.tensor([True, False])
    run_a = Episodes(
        score=torch.tensor([1.0, 3.0]),
        length=torch.tensor([10.0, 30.0]),
        fell=flags,
        diverged=~flags,
        terms=torch.tensor([[1.0, 0.0], [2.0, 1.0]]),
        outcomes={"vx": torch.tensor([10.0, 60.0])},
        success=flags,
    )
    run_b = run_a._replace(score=torch.tensor([5.0, 7.0]), fell=torch.tensor([False, False]))
    results = figures([run_a, run_b], ("a", "b"))
    assert results["score"] == {"mean": 4.0, "std": pytest.approx(math.sqrt(20 / 3)), "min": 1.0, "max": 7.0}
    assert results["fall_rate"] == 0.25
    assert results["diverged_rate"] == 0.5
    assert results["success_rate"] == 0.5
    assert results["terms"]["a"]["mean"] == 1.5
    # 140 metres in 80 steps; the episodes' own speeds are 1 and 2.
    assert results["outcomes"]["vx"]["mean"] == 1.75
    assert (results["outcomes"]["vx"]["min"], results["outcomes"]["vx"]["max"]) == (1.0, 2.0)


def test_stored_policies_score_as_they_did_in_training(trial: Path) -> None:
    rows = {row["epoch"]: row for row in read_metrics(trial / "metrics.jsonl")}
    kept = milestones(trial / "checkpoints")
    assert [epoch for epoch, _ in kept] == [0, 2, 4, 6]
    bench = Bench("cpu")
    for epoch, path in kept:
        assert bench.evaluate(load_policy(path), Request())["score"]["mean"] == rows[epoch]["eval/score"]
    shutil.rmtree(trial / "checkpoints" / "nothing", ignore_errors=True)
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        load_policy(trial / "checkpoints" / "policy_000001.pt")


def test_a_broken_eval_file_is_not_overwritten(trial: Path) -> None:
    (trial / "eval.json").write_text("{")
    assert run(main, [str(trial), "--device", "cpu", "--steps", "2"]) == 2
    assert (trial / "eval.json").read_text() == "{"
    (trial / "eval.json").unlink()
    assert run(main, [str(trial), "--device", "cpu", "--steps", "2"]) == 0
    (first,) = entries(trial)
    store_evaluation(trial / "eval.json", first | {"checkpoint": "other.pt"})
    assert entries(trial) == [first, first | {"checkpoint": "other.pt"}]


@pytest.mark.parametrize("text", ["0", "-1", "²", "2.5", str(2**31)])
def test_counts_are_whole_numbers_that_devices_have(text: str) -> None:
    assert positive(str(2**31 - 1)) == 2**31 - 1
    with pytest.raises(argparse.ArgumentTypeError, match=r"at least 1 and below 2\^31, not"):
        positive(text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["smal"], "did you mean 'small'?"),
        (["nothing"], "no checkpoint, trial or experiment 'nothing'"),
        (["small", "--physics", "published"], "env cartpole has no such physics"),
        (["small", "--seeds", "x"], "write whole numbers"),
        (["small", "--device", "cuda:9"], "write --device cpu"),
        (["small/manifest.json"], "is not a checkpoint"),
        (["small/trials/nothing"], "give a .pt file"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    sweep: Experiment, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    storage = ["--storage", str(sweep.path.parent)]
    code = run(main, [*arguments, *storage])
    error = capsys.readouterr().err
    assert code == 2
    lines = [line for line in error.splitlines() if not line.startswith("Warp ")]
    assert len(lines) == 1
    assert message in lines[0]


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["cartpole", "ant"])
def test_cpu_and_gpu_agree_over_the_first_hundred_steps(name: str, sweep: Experiment, ant_trial: Path) -> None:
    """Same initial states, but for the last bits of an orientation. After 100 steps of float32, whose rounding differs
    and contact amplifies, the median world's positions differ by less than 1e-3 (CartPole) and 2e-2 (ant) [m, rad],
    mean scores by 1 %."""
    best = best_records(read_records(sweep)).get("cartpole")
    assert best is not None
    folder = ant_trial if name == "ant" else best.folder
    policy = load_policy(folder / "checkpoints" / "best.pt")
    tolerance = 2e-2 if name == "ant" else 1e-3
    paths, scores = [], []
    for device in ("cpu", "cuda:0"):
        evaluator, _ = Bench(device).evaluator(policy.config, Request(worlds=16, steps=100))
        states: list[torch.Tensor] = []
        episodes = evaluator.episodes(
            policy.on(evaluator.env), None, lambda s, a, kept=states: kept.append(s.qpos.cpu())
        )
        paths.append(torch.stack(states))
        scores.append(episodes.score.cpu())
    steps = min(len(path) for path in paths)
    cpu, gpu = (path[:steps] for path in paths)
    torch.testing.assert_close(cpu[0], gpu[0], rtol=0.0, atol=1e-6)
    assert (cpu - gpu).abs().amax((0, 2)).median() < tolerance
    assert (scores[0].mean() - scores[1].mean()).abs() < 0.01 * scores[0].abs().mean()


@pytest.mark.gpu
def test_a_gpu_gives_the_same_numbers_twice(sweep: Experiment) -> None:
    best = best_records(read_records(sweep)).get("cartpole")
    assert best is not None
    policy = load_policy(best.folder / "checkpoints" / "best.pt")
    first, second = (Bench("cuda:0").evaluate(policy, Request()) for _ in range(2))
    assert first["scores"] == second["scores"]
