"""What `import msk_ray` gives, and what it costs."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch
from scenes import cartpole

import msk_ray
from msk_ray.errors import ConfigError, StorageError
from msk_ray.experiment.provenance import read_environment


def test_importing_loads_neither_torch_nor_warp() -> None:
    code = (
        "import sys, msk_ray; dir(msk_ray); msk_ray.load_config; msk_ray.train; "
        "print([m for m in ('torch', 'warp', 'ray', 'mujoco_warp') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", [name for name in msk_ray.__all__ if name != "__version__"])
def test_every_name_is_found_and_listed(name: str) -> None:
    assert getattr(msk_ray, name).__name__.rpartition(".")[2] == name
    assert name in dir(msk_ray)


def test_an_unknown_name_says_which_there_are() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'Simulator'; it has .*Simulation"):
        _ = msk_ray.Simulator


@pytest.mark.parametrize("first", ["msk_ray.train", "import msk_ray.train"])
def test_train_is_a_function_and_a_module_in_either_order(first: str) -> None:
    code = f"import msk_ray; {first}; import msk_ray.train; print(msk_ray.train.parser().prog, callable(msk_ray.train))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "python -m msk_ray.train True"


def test_training_gives_the_best_policy(tiny_cartpole: msk_ray.Config, tmp_path: Path) -> None:
    rows: list[dict[str, float]] = []
    trained = msk_ray.train(tiny_cartpole, tmp_path / "mine", "cpu", on_epoch=rows.append)
    assert [row["epoch"] for row in rows] == [1, 2, 3, 4, 5, 6]
    assert trained.epochs == 6
    assert trained.best_score == max(row["eval/score"] for row in rows if "eval/score" in row)
    policy = msk_ray.load_policy(trained.best_checkpoint)
    assert policy.config == tiny_cartpole
    assert policy.sizes == (5, 1)
    ran_with, damages = read_environment(tmp_path / "mine" / "env.json")
    assert not damages
    assert ran_with["device"] == "cpu"
    assert ran_with["command"]


def test_the_readme_example_runs(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a CPU, with another model, and with two epochs of few worlds instead of all of them."""
    example = (root / "README.md").read_text().split("```python\n")[1].split("```")[0]
    small = '["trial.epochs=2", "env.nworld=4", "evaluation.nworld=2", "evaluation.steps=4", "shac.critic_batches=1"]'
    for text, instead in (
        ('device="cuda"', 'device="cpu"'),
        ('"configs/cartpole.yaml"', f'"{root}/configs/cartpole.yaml", {small}'),
    ):
        assert text in example
        example = example.replace(text, instead)
    mujoco.mj_saveLastXML(str(tmp_path / "model.xml"), cartpole())
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(example, names)
    assert names["ctrl"].grad.shape == (64, 1)
    assert names["ctrl"].grad.abs().min() > 0.0
    assert names["policy"].epoch == names["trained"].epochs == 2


def test_training_goes_on_where_it_was_interrupted(tiny_cartpole: msk_ray.Config, tmp_path: Path) -> None:
    def interrupt(row: dict[str, float]) -> None:
        if row["epoch"] == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        msk_ray.train(tiny_cartpole, tmp_path, "cpu", on_epoch=interrupt)
    with pytest.raises(StorageError, match="in Python resume=True"):
        msk_ray.train(tiny_cartpole, tmp_path, "cpu")
    rows: list[dict[str, float]] = []
    newest = sorted((tmp_path / "checkpoints").glob("epoch_*.pt"))[-1]
    (tmp_path / "checkpoints" / "epoch_000003.pt").write_bytes(newest.read_bytes()[:100])
    with pytest.warns(UserWarning, match=r"skipped: .*epoch_000003\.pt"):
        trained = msk_ray.train(tiny_cartpole, tmp_path, "cpu", resume=True, on_epoch=rows.append)
    assert [row["epoch"] for row in rows] == [3, 4, 5, 6]
    assert trained.epochs == 6


def test_training_takes_settings_and_no_path(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"not str: write msk_ray\.load_config"):
        msk_ray.train("configs/cartpole.yaml", tmp_path)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def simulation() -> "msk_ray.Simulation":
    return msk_ray.Simulation(cartpole(), nworld=2, substeps=1, backward="tape_per_substep", device="cpu")


def test_a_mode_by_name_differentiates(simulation: "msk_ray.Simulation") -> None:
    assert isinstance(simulation.backward, msk_ray.TapePerSubstep)
    ctrl = torch.zeros(2, 1, requires_grad=True)
    simulation.step(ctrl, *simulation.initial_state()).qvel.sum().backward()
    assert ctrl.grad is not None
    assert ctrl.grad.abs().min() > 0


def test_a_mode_nobody_knows_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"unknown backward mode 'tape': write one of tape_per_substep, tape_all"):
        msk_ray.Simulation(cartpole(), nworld=1, substeps=1, backward="tape", device="cpu")


def test_a_path_is_no_model() -> None:
    with pytest.raises(ConfigError, match=r"not str: write mujoco\.MjModel\.from_xml_path"):
        msk_ray.Simulation("ant.xml", nworld=1, substeps=1)  # type: ignore[arg-type]


def test_inputs_of_another_shape_or_dtype_are_named(simulation: "msk_ray.Simulation") -> None:
    qpos, qvel, act = simulation.initial_state()
    ctrl = torch.zeros(2, 1)
    with pytest.raises(ConfigError, match=r"ctrl has shape \(1, 1\), but 2 worlds of this model take \(2, 1\)"):
        simulation.step(ctrl[:1], qpos, qvel, act)
    with pytest.raises(ConfigError, match=r"qvel is torch\.float64: write qvel\.float\(\)"):
        simulation.step(ctrl, qpos, qvel.double(), act)
    with pytest.raises(ConfigError, match=r"qpos is on meta, the simulation on cpu: write qpos\.to\('cpu'\)"):
        simulation.step(ctrl, qpos.to("meta"), qvel, act)
    assert isinstance(simulation.model, mujoco.MjModel)
