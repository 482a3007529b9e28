"""Recorded epochs: the same mathematics as operation by operation. On a CUDA device."""

import copy
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from disturbed import DISTURBANCES

from msk_ray.algorithms.shac import unrolling
from msk_ray.config import parse_config
from msk_ray.envs.cartpole.env import CartPole
from msk_ray.errors import SimulationError
from msk_ray.training import Trainer
from msk_ray.training.determinism import use_determinism

pytestmark = pytest.mark.gpu
# `execution.deterministic` needs it before CUDA starts, which it does in the first of these tests.
os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")

ANT = {
    "env": {"name": "ant", "nworld": 64},
    "physics": {"variant": "matched"},
    "shac": {"horizon": 4, "critic_iterations": 2, "state_grad_clip": 100.0, "normalize_return": True},
    "evaluation": {"interval": 1000, "nworld": 2, "steps": 2},
    "trial": {"epochs": 1000},
    "execution": {"checkpoint_interval": 1000, "loggers": []},
}
OPTIONS = {
    **ANT,
    "actor": {"state_std": True},
    "critic": {"count": 2},
    "shac": {
        **ANT["shac"],
        "critic_iterations": 6,
        "critic_tolerance": 0.05,
        "weight_decay": 0.01,
        "actor_value": "mean",
        "entropy": {"target": -0.5, "normalize": True},
        "horizon": {"kind": "contact", "start": 4, "shortest": 4, "longest": 4, "contact": 1.0},
    },
}
_WEIGHTS = (
    *("metabolic", "head", "impact", "footfall", "landing", "clearance", "toes", "vault", "track"),
    "track_rate",
)
LEGS = {
    **ANT,
    "env": {
        "name": "myoleg26",
        "nworld": 64,
        "clock": True,
        "symmetric": True,
        "reset": "cycle",
        "speed_range": [1.0, 1.5],
        "reward": dict.fromkeys(_WEIGHTS, 0.1),
    },
    "physics": {},
}
ONE_KERNEL = {**ANT, "physics": {"variant": "matched"}, "execution": {**ANT["execution"], "solver_kernels": "fused"}}
MEMORY = {**ANT, "env": {"name": "remembering:Remembering", "nworld": 64}}
CARTPOLE = {**ANT, "env": {"name": "cartpole", "nworld": 64}, "physics": {}}
PRIVILEGED = {**CARTPOLE, "env": {"name": "privileged:Privileged", "nworld": 64}}
DISTURBED = {**CARTPOLE, "physics": {"randomize": DISTURBANCES}}


def make(settings: dict[str, Any], folder: Path, capture: str = "auto", **shac: Any) -> Trainer:
    parts = {"shac": {**settings["shac"], **shac}, "execution": {**settings["execution"], "capture": capture}}
    return Trainer(parse_config({**settings, **parts}), folder, "cuda:0")


@pytest.fixture
def uncut(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings unroll more iterations than any world needs, so that they do what an eager epoch does."""
    monkeypatch.setattr(unrolling, "FEWEST", 32)


@pytest.fixture
def torch_as_before() -> Iterator[None]:
    yield
    use_determinism(parse_config({"env": {"name": "cartpole"}}), "cuda:0")


def run_epochs(trainer: Trainer, count: int) -> None:
    for _ in range(count):
        trainer.run_epoch()


def weights(trainer: Trainer) -> torch.Tensor:
    trainer.algorithm.state_dict()  # waits for the critic
    found = [p.detach().flatten() for p in trainer.algorithm.network.parameters()]
    return torch.cat([*found, *(p.detach().flatten() for p in trainer.algorithm.critic.parameters())])


def difference(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).norm() / b.norm())


def after(epochs: int, trainer: Trainer, state: dict[str, Any]) -> tuple[torch.Tensor, dict[str, float]]:
    trainer.algorithm.load_state_dict(copy.deepcopy(state))
    trainer.epoch = 10
    for _ in range(epochs):
        row = trainer.run_epoch()
    return weights(trainer), row


@pytest.mark.usefixtures("uncut")
@pytest.mark.parametrize(
    "settings",
    [ANT, CARTPOLE, OPTIONS, LEGS, ONE_KERNEL, MEMORY, PRIVILEGED, DISTURBED],
    ids=["ant", "cartpole", "options", "legs", "one_kernel", "memory", "privileged", "disturbed"],
)
def test_a_recorded_epoch_equals_one_operation_by_operation(settings: dict[str, Any], tmp_path: Path) -> None:
    recorded, eager = make(settings, tmp_path / "a"), make(settings, tmp_path / "b", capture="off")
    for trainer in (recorded, eager):
        for _ in range(3):
            trainer.run_epoch()
    state = copy.deepcopy(recorded.algorithm.state_dict())
    (a, row), (b, _) = (after(1, recorded, state) for _ in range(2))
    (c, expected), (d, _) = (after(1, eager, state) for _ in range(2))
    assert (row["train/recorded"], expected["train/recorded"]) == (1.0, 0.0)
    names = ("train/reward", "train/actor_loss", "train/value", "grad/actor_norm", "grad/state_median")
    for name in names:
        assert row[name] == pytest.approx(expected[name], rel=1e-4), name
    # Sums by atomics differ in their last bits from run to run, and Adam makes steps of them where a gradient is 0.
    noise = max(difference(a, b), difference(c, d))
    assert difference(a, c) < 1e-6 + 3.0 * noise


def test_few_iterations_are_cut_and_change_little(tmp_path: Path) -> None:
    """With the usual limits: what an epoch finds after twelve, recorded and operation by operation."""
    settings = {**ANT, "env": {"name": "ant", "nworld": 1024}}
    recorded, eager = make(settings, tmp_path / "a"), make(settings, tmp_path / "b", capture="off")
    run_epochs(recorded, 12)
    run_epochs(eager, 1)
    state = copy.deepcopy(recorded.algorithm.state_dict())
    (_, row), (_, expected) = (after(1, trainer, state) for trainer in (recorded, eager))
    assert max(recorded.algorithm.env.sim.batch.unrolled_iterations) < 32
    assert row["physics/solver_limit_share"] < 0.05
    assert row["physics/solver_unconverged_share"] < 0.005
    assert row["train/reward"] == pytest.approx(expected["train/reward"], rel=1e-3)
    assert row["grad/actor_norm"] == pytest.approx(expected["grad/actor_norm"], rel=2e-2)
    assert row["grad/state_median"] == pytest.approx(expected["grad/state_median"], rel=2e-2)


@pytest.mark.usefixtures("uncut", "torch_as_before")
def test_a_fit_beside_a_rollout_equals_one_after_the_other(tmp_path: Path) -> None:
    """Fails, or never ends, if both write to one workspace of a library. The networks are those of configs/ant.yaml.

    To the bit: without a fixed order of sums, their noise grows from epoch to epoch by an amount no test can bound.
    """
    networks = {name: {"hidden": [400, 200, 100]} for name in ("actor", "critic")}
    wide = {**ANT, **networks, "execution": {**ANT["execution"], "deterministic": True}}
    shac = {"horizon": 8, "critic_iterations": 16}
    recorded, eager = make(wide, tmp_path / "a", **shac), make(wide, tmp_path / "b", **shac, capture="off")
    for trainer in (recorded, eager):
        run_epochs(trainer, 3)
    state = copy.deepcopy(recorded.algorithm.state_dict())
    (a, row), (b, expected) = (after(2, trainer, state) for trainer in (recorded, eager))
    assert (row["train/recorded"], expected["train/recorded"]) == (1.0, 0.0)
    assert row["train/value"] == expected["train/value"]
    assert torch.equal(a, b)


def test_horizons_have_recordings_of_their_own(tmp_path: Path) -> None:
    trainer = make(CARTPOLE, tmp_path, horizon={"kind": "schedule", "start": 2, "end": 6, "epochs": 2})
    rows = [trainer.run_epoch() for _ in range(6)]
    assert [row["train/horizon"] for row in rows] == [2, 4, 6, 6, 6, 6]
    assert [row["train/recorded"] for row in rows] == [0, 0, 0, 1, 1, 1]


def test_a_resumed_trial_goes_on_as_before(tmp_path: Path) -> None:
    trainer = make(CARTPOLE, tmp_path / "a", entropy={"coefficient": 0.1, "target": -0.5})
    for _ in range(4):
        trainer.run_epoch()
    path = trainer.save()
    rows = [trainer.run_epoch() for _ in range(3)]
    again = make(CARTPOLE, tmp_path / "b", entropy={"coefficient": 0.1, "target": -0.5})
    again.restore(path)
    resumed = [again.run_epoch() for _ in range(3)]
    assert resumed[-1]["train/recorded"] == 1.0
    # Each row has the loss of the fit before, the first one that of a fit before the checkpoint.
    name = "train/critic_loss"
    assert [row[name] for row in resumed] == pytest.approx([row[name] for row in rows], rel=1e-3)
    assert difference(weights(again), weights(trainer)) < 1e-4


def test_an_environment_that_makes_the_host_wait_runs_operation_by_operation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terms = CartPole.reward_terms

    def waiting(self: CartPole, *args: Any) -> torch.Tensor:
        found = terms(self, *args)
        return found * (1.0 if float(found.detach().sum()) < 1e9 else 0.0)

    monkeypatch.setattr(CartPole, "reward_terms", waiting)
    trainer = make(CARTPOLE, tmp_path)
    trainer.run_epoch()
    with pytest.warns(UserWarning, match=r"test_recorded\.py:\d+ cannot be recorded"):
        row = trainer.run_epoch()
    assert (row["train/recorded"], row["train/unrecordable"]) == (0.0, 1.0)
    (remark,) = trainer.remarks()
    assert remark.startswith(
        "epochs run operation by operation, not as recorded graphs, and take two to three times as"
    )
    assert "test_recorded.py:" in remark
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert trainer.run_epoch()["train/recorded"] == 0.0


def test_a_gradient_that_is_not_finite_is_reported_and_moves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scale = torch.ones((), device="cuda:0")
    terms = CartPole.reward_terms
    monkeypatch.setattr(CartPole, "reward_terms", lambda self, *args: scale * terms(self, *args))
    trainer = make(CARTPOLE, tmp_path)
    for _ in range(3):
        trainer.run_epoch()
    before = [p.detach().clone() for p in trainer.algorithm.network.actor.parameters()]
    scale.fill_(float("nan"))
    with pytest.raises(SimulationError, match="nonfinite_reward: term 'pole_angle' of reward_terms is nan in world 0 "):
        trainer.run_epoch()
    after = list(trainer.algorithm.network.actor.parameters())
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_a_step_that_loses_rows_is_reported(tmp_path: Path) -> None:
    settings = {**ANT, "physics": {"variant": "matched"}, "execution": {**ANT["execution"], "njmax": 12}}
    trainer = make(settings, tmp_path)
    with pytest.raises(SimulationError, match=r"execution\.njmax"):
        run_epochs(trainer, 40)


def test_shares_are_of_all_steps_of_an_epoch(tmp_path: Path) -> None:
    """Fails, with four times the share, where Python counts the steps that a recording replays.

    The share is that of the states of an epoch, of which one in four to five has no gradient to clip, and not the same
    ones in the next.
    """
    settings = {**ANT, "physics": {"variant": "matched", "substep_grad_clip": 1e-12}}
    trainer = make(settings, tmp_path)
    rows = [trainer.run_epoch() for _ in range(4)]
    assert [row["train/recorded"] for row in rows] == [0.0, 1.0, 1.0, 1.0]
    first, *others = (row["physics/substep_clip_share"] for row in rows)
    assert others == pytest.approx([first] * 3, rel=0.2)
