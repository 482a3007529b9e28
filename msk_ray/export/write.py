"""Write a policy, its description and its model."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from msk_ray.envs import Env, env_class, make_env
from msk_ray.evaluate.measure import named_physics
from msk_ray.export.compare import CHECKED, WORLDS, compare_with_checkpoint, observations
from msk_ray.export.description import describe
from msk_ray.export.formats import FORMATS
from msk_ray.export.network import PolicyToControl
from msk_ray.files import write_bytes, write_json
from msk_ray.training import SavedPolicy, load_policy


def export(checkpoint: Path, paths: Mapping[str, Path], physics: str) -> Iterator[str]:
    """Write the policy of a checkpoint to each of `paths`, by its name in `FORMATS`, and a .json and an .mjb of
    the same name. Yields a line about each file.

    Args:
        physics: of the model: `reference`, `own`, or the name of one of the environment's.

    Raises:
        ExportError: an exported policy differs from the checkpoint's, or cannot be made; nothing is written.
        ConfigError, CheckpointError, UnsupportedModelError, StorageFailure: as their messages say.
    """
    saved = load_policy(checkpoint)
    policy, env, shown = policy_to_control(saved, physics)
    seed = saved.config.evaluation.seed
    inputs = policy.examples(observations(env, seed), seed)
    checked = {}
    for name in paths:
        payload, runner = FORMATS[name].write(policy, *inputs)
        checked[name] = payload, compare_with_checkpoint(policy, runner, env, *inputs)
    descriptions: dict[Path, dict[str, str]] = {}
    for name, path in paths.items():
        payload, difference = checked[name]
        write_bytes(path, payload)
        yield f"{path}: {len(payload)} bytes, differs by at most {difference:.0e} on {CHECKED} observations"
        descriptions.setdefault(path.with_suffix(".json"), {})[name] = path.name
    for path, files in descriptions.items():
        model = path.with_suffix(".mjb")
        write_bytes(model, model_bytes(env.model))
        yield f"{model}: the model under {shown} physics, for MuJoCo {mujoco.__version__}"
        about = describe(saved, policy, env, shown, {**files, "model": model.name})
        write_json(path, about)
        unnamed = about["observation"]["entries"] is None
        hint = (
            f"; to name entries of the observation, write {type(env).__qualname__}.observation_layout"
            if unnamed
            else ""
        )
        yield f"{path}: observation, action, periods{hint}"
    yield from policy.remarks


def policy_to_control(saved: SavedPolicy, physics: str) -> tuple[PolicyToControl, Env[Any], str]:
    """The network to export, the environment that it acts in, on the CPU, and the name of its physics.

    Raises:
        ConfigError, CheckpointError, UnsupportedModelError, ExportError: as their messages say.
    """
    shown, chosen = named_physics(saved.config, physics)
    settings = env_class(saved.config.env).reference_settings(saved.config.env)
    env = make_env(settings, chosen, WORLDS, "cpu", saved.config.evaluation.seed, differentiable=False)
    return PolicyToControl(saved.network(env), env).eval().requires_grad_(False), env, shown


def model_bytes(model: mujoco.MjModel) -> bytes:
    """A model in MuJoCo's binary format."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()
