"""What tells whether two runs are the same, and what their bits depend on."""

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from msk_ray.config import Config, parse_config
from msk_ray.errors import CheckpointError
from msk_ray.experiment.checkpoint_format import read_facts
from msk_ray.networks import as_number, parameter_hash
from msk_ray.training import Trainer, read_metrics
from msk_ray.training.checkpoint import read_checkpoint, write_checkpoint

Settings = dict[str, Any]


def with_trial(settings: Settings, **trial: Any) -> Config:
    return parse_config(settings | {"trial": settings["trial"] | trial})


def train(config: Config, folder: Path, epochs: int = 2) -> Trainer:
    trainer = Trainer(config, folder, "cpu")
    for _ in range(epochs):
        trainer.run_epoch()
    trainer.close()
    return trainer


def hashes(folder: Path) -> list[float]:
    return [row["hash/parameters"] for row in read_metrics(folder / "metrics.jsonl") if "eval/score" in row]


def test_a_hash_depends_on_names_types_shapes_and_bits_alone() -> None:
    a, b = torch.arange(6.0), torch.ones(2, 2)
    one = {"actor": {"w": a, "b": b}, "critic": {"w": b}}
    assert parameter_hash(one) == parameter_hash({"critic": {"w": b.clone()}, "actor": {"b": b, "w": a}})
    changed: list[Mapping[str, Mapping[str, object]]] = [
        {**one, "critic": {"w": a}},
        {**one, "critic": {"v": b}},
        {**one, "critic": {"w": b.double()}},
        {**one, "actor": {"w": a.view(2, 3), "b": b}},
        {**one, "critic": {"w": torch.nextafter(b, b + 1)}},
        {**one, "critic": {"w": b, "count": 1}},
    ]
    assert len({parameter_hash(other) for other in [one, *changed]}) == 1 + len(changed)
    assert as_number("f" * 32) == 2**48 - 1


def test_evaluations_and_checkpoints_have_the_hash_of_what_was_learned(tiny_settings: Settings, tmp_path: Path) -> None:
    config = with_trial(tiny_settings)
    first = train(config, tmp_path / "first")
    train(config, tmp_path / "second")
    train(with_trial(tiny_settings, seed=1), tmp_path / "other")
    ours = hashes(tmp_path / "first")
    assert len(set(ours)) == 2  # before training, and after two epochs
    assert hashes(tmp_path / "second") == ours
    assert not set(hashes(tmp_path / "other")) & set(ours)
    newest = tmp_path / "first" / "checkpoints" / "epoch_000002.pt"
    assert read_facts(newest)["parameters"] == first.algorithm.parameter_hash()
    assert as_number(first.algorithm.parameter_hash()) == ours[-1]


def test_a_checkpoint_of_other_weights_than_it_says_is_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, state = tmp_path / "epoch_000001.pt", {"algorithm": {"modules": {"actor": {"w": torch.ones(3)}}}}
    write_checkpoint(path, state, {"epoch": 1})
    assert read_checkpoint(path)["algorithm"]["modules"]["actor"]["w"].tolist() == [1.0, 1.0, 1.0]
    monkeypatch.setattr("msk_ray.training.checkpoint.parameter_hash", lambda modules: "0" * 32)
    write_checkpoint(path, state, {"epoch": 1})
    monkeypatch.undo()
    with pytest.raises(CheckpointError, match="damaged: its weights do not match"):
        read_checkpoint(path)


def test_a_trial_that_goes_on_elsewhere_says_that_bits_differ(tiny_settings: Settings, tmp_path: Path) -> None:
    config = with_trial(tiny_settings)
    train(config, tmp_path)
    path = tmp_path / "env.json"
    facts = json.loads(path.read_text())
    assert (facts["device"], facts["deterministic"]) == ("cpu", False)
    assert {"torch", "warp-lang", "mujoco", "mujoco-warp"} <= set(facts["packages"])

    def resumed() -> list[str]:
        trainer = Trainer(config, tmp_path, "cpu")
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            trainer.restore_latest()
        trainer.close()
        return [str(w.message) for w in heard if "bits will differ" in str(w.message)]

    assert resumed() == []
    path.write_text(json.dumps(facts | {"device": "NVIDIA H200", "packages": facts["packages"] | {"torch": "2.0"}}))
    (line,) = resumed()
    assert "NVIDIA H200, now cpu; torch 2.0, now " in line
