"""What tells whether two runs are the same, what their bits depend on, and seeds of parts of a trial."""

import json
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from msk_ray.algorithms.ppo.algorithm import Ppo
from msk_ray.algorithms.shac.algorithm import Shac
from msk_ray.config import Config, parse_config
from msk_ray.errors import CheckpointError, ConfigError
from msk_ray.experiment.checkpoint_file import read_facts
from msk_ray.networks import as_number, parameter_hash
from msk_ray.training import Trainer, read_metrics
from msk_ray.training.checkpoint import read_checkpoint, write_checkpoint
from msk_ray.training.learner import make_algorithm

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
    with pytest.raises(CheckpointError, match="damaged: its weights are not those"):
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


def drawn(algorithm: Shac | Ppo) -> dict[str, Any]:
    """What each part of a trial's start has drawn, in a form that can be compared."""
    states = [t.tolist() for t in algorithm.env.state.physics]
    if isinstance(algorithm, Shac):
        inputs = algorithm._draw(3, 0)
        orders = algorithm.critic_fit.draw_orders(24, 2, algorithm.minibatch_generator)
        found = {"noise": inputs.noise.tolist(), "minibatches": orders.tolist()}
    else:
        found = {}
        for part in ("noise", "minibatches"):
            with algorithm._drawing(part):
                found[part] = torch.rand(4).tolist()
    return {
        "policy": parameter_hash({n: m.state_dict() for n, m in algorithm.modules().items()}),
        "states": states,
    } | found


@pytest.fixture(params=["shac", "ppo"])
def start(request: pytest.FixtureRequest, tiny_settings: Settings) -> Callable[..., dict[str, Any]]:
    """What a trial with these seeds draws at its start."""
    network = {"hidden": [16, 16], "layer_norm": False}
    own = {"algorithm": {"name": "ppo"}, "ppo": {"steps": 8}, "actor": network, "critic": network}
    settings = tiny_settings | own if request.param == "ppo" else tiny_settings

    def made(seed: int = 3, **seeds: int) -> dict[str, Any]:
        algorithm = make_algorithm(with_trial(settings, seed=seed, seeds=seeds), "cpu")
        assert isinstance(algorithm, (Shac, Ppo))
        return drawn(algorithm)

    return made


ALL = ("policy", "states", "noise", "minibatches")


def test_each_seed_varies_its_part_and_holds_the_others(start: Callable[..., dict[str, Any]]) -> None:
    held = dict.fromkeys(ALL, 7)
    before = start(**held)
    for part in ALL:
        after = start(**held | {part: 8})
        assert {name for name in ALL if after[name] != before[name]} == {part}
    # Every part is named: the number that sets all does nothing.
    assert start(seed=4, **held) == before


def test_one_number_sets_all_parts(start: Callable[..., dict[str, Any]]) -> None:
    one, other = start(seed=3), start(seed=4)
    assert all(one[part] != other[part] for part in ALL)
    named = start(seed=4, policy=3, states=3)
    assert (named["policy"], named["states"]) == (one["policy"], one["states"])


def test_parts_of_their_own_go_on_where_a_checkpoint_ends(tiny_settings: Settings, tmp_path: Path) -> None:
    config = with_trial(tiny_settings, seeds={"noise": 5})
    train(config, tmp_path / "whole", 4)
    train(config, tmp_path / "halves", 2)
    trainer = Trainer(config, tmp_path / "halves", "cpu")
    trainer.restore_latest()
    for _ in range(2):
        trainer.run_epoch()
    trainer.close()
    assert hashes(tmp_path / "halves") == hashes(tmp_path / "whole")


def test_an_algorithm_that_draws_from_one_generator_refuses_them(
    tiny_settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Shac, "draws_apart", False)
    make_algorithm(with_trial(tiny_settings, seeds={"states": 1}), "cpu")
    with pytest.raises(ConfigError, match=r"write trial\.seeds\.states alone"):
        make_algorithm(with_trial(tiny_settings, seeds={"policy": 1}), "cpu")
