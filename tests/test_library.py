"""What `import msk_ray` gives, and what it costs."""

import subprocess
import sys

import mujoco
import pytest
import torch
from scenes import cartpole

import msk_ray
from msk_ray.errors import ConfigError


def test_importing_loads_neither_torch_nor_warp() -> None:
    code = (
        "import sys, msk_ray; dir(msk_ray); msk_ray.load_config; "
        "print([m for m in ('torch', 'warp', 'ray', 'mujoco_warp') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", [name for name in msk_ray.__all__ if name != "__version__"])
def test_every_name_is_found_and_listed(name: str) -> None:
    assert getattr(msk_ray, name).__name__ == name
    assert name in dir(msk_ray)


def test_an_unknown_name_says_which_there_are() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'Simulator'; it has .*Simulation"):
        _ = msk_ray.Simulator


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
