"""The .json beside an exported policy: what another program must know to run it."""

import inspect
from collections.abc import Mapping
from typing import Any

import mujoco

import msk_ray
from msk_ray.envs import Env
from msk_ray.errors import ConfigError
from msk_ray.export.compare import CHECKED, TOLERANCE
from msk_ray.export.network import PolicyToControl
from msk_ray.training import SavedPolicy

FORMAT = 2


def describe(
    saved: SavedPolicy, policy: PolicyToControl, env: Env[Any], physics: str, files: Mapping[str, str]
) -> dict[str, Any]:
    """The description as plain data.

    Args:
        saved: the checkpoint's policy.
        policy: the policy that was exported.
        env: its environment.
        physics: name of the physics of the model.
        files: names of the files by their names in `FORMATS`, and that of the `model`.

    Raises:
        ConfigError: the environment's layout does not fit its observation.
    """
    model, option = env.model, env.model.opt
    layout = env.observation_layout()
    if layout is not None and len(layout) != env.obs_size:
        raise ConfigError(
            f"observation_layout of {type(env).__qualname__} has {len(layout)} entries for observations of size "
            f"{env.obs_size}"
        )
    given = policy.memory.given
    return {
        "format": FORMAT,
        "files": dict(files),
        "input": {"name": "obs", "shape": ["batch", len(given)], "dtype": "float32"},
        "memory": [
            {
                "input": carried.name,
                "shape": ["batch", len(carried.start)],
                "dtype": "float32",
                "start": carried.start.tolist(),
                "output": carried.output,
            }
            for carried in policy.carried
        ],
        "calls": "one for each control period; each input of `memory` is its `start` in the first call of an episode, "
        "then its `output` of the call before",
        "outputs": policy.outputs,
        "observation": {
            "size": len(given),
            "entries": None
            if layout is None
            else [{"name": layout[place].name, "unit": layout[place].unit} for place in given],
            "description": _own_docstring(type(env)),
        },
        "action": {"size": env.action_size, "range": [-1.0, 1.0], "names": env.action_names()},
        "ctrl": _controls(model) if policy.gives_control else None,
        "control_period_s": saved.config.env.control_timestep,
        "physics_steps_per_control": env.sim.substeps,
        "model": {
            "physics": physics,
            "mujoco": mujoco.__version__,
            "timestep_s": option.timestep,
            "nq": model.nq,
            "nv": model.nv,
            "na": model.na,
            "start": _start(env),
            "joints": [model.joint(i).name for i in range(model.njnt)],
        },
        "trained": {
            "checkpoint": saved.path.name,
            "sha256": saved.sha256,
            "epoch": saved.epoch,
            "env_steps": saved.env_steps,
            "env": saved.config.env.name,
            "env_settings": saved.config.env.model_dump(mode="json"),
            "algorithm": saved.config.algorithm.name,
            "msk_ray": msk_ray.__version__,
        },
        "checked": {"observations": CHECKED, "tolerance": TOLERANCE},
    }


def _own_docstring(of: type) -> str | None:
    """A class's own docstring; None if it has none. An inherited one would describe another class."""
    return None if of.__doc__ is None else inspect.cleandoc(of.__doc__)


def _start(env: Env[Any]) -> dict[str, list[float]]:
    """An initial state without noise."""
    config = env.config
    env.config = config.model_copy(update={"stochastic_reset": False})
    start = env.draw_physics(1)
    env.config = config
    return {name: part[0].tolist() for name, part in start._asdict().items()}


def _controls(model: mujoco.MjModel) -> dict[str, Any]:
    return {
        "size": model.nu,
        "names": [model.actuator(i).name or f"actuator_{i}" for i in range(model.nu)],
        "ranges": [
            model.actuator_ctrlrange[i].tolist() if model.actuator_ctrllimited[i] else None for i in range(model.nu)
        ],
    }
