"""A setting of the physics section does something, or is refused: in every environment, with every backward mode."""

from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
from myosuite_model import walk_model

from msk_ray.config import Config, PhysicsConfig, overlay, parse_config
from msk_ray.config.physics import FdConfig
from msk_ray.envs import env_class, make_env
from msk_ray.envs.make import configured_backward
from msk_ray.errors import ConfigError
from msk_ray.step import Kernels
from msk_ray.step.autograd.modes import BACKWARD_MODES

VALUES: dict[str, Any] = {
    "variant": "published",
    "substep_grad_clip": 5.0,
    "substeps": 7,
    "timestep": 0.0025,
    "tolerance": 1e-9,
    "iterations": 7,
    "ls_iterations": 3,
    "integrator": "RK4",
    "cone": "pyramidal",
    "solref": [0.03, 0.9],
    "solimp": [0.8, 0.9, 0.02, 0.5, 2.0],
    "solreffriction": [0.5, 1.0],
    "fd.eps_ctrl": 0.01,
    "fd.eps_qpos": 0.01,
    "fd.eps_qvel": 0.01,
    "fd.eps_act": 0.01,
}
REFUSED = {
    "cartpole": {
        "variant",
        "tolerance",
        "iterations",
        "ls_iterations",
        "cone",
        "solref",
        "solimp",
    }
    | {"solreffriction", "fd.eps_act"},
    "ant": {"fd.eps_act"},
    "hopper": {"fd.eps_act"},
    "cheetah": {"fd.eps_act"},
    "humanoid": {"fd.eps_act"},
    "myoleg26": {"variant"},
    "myoleg": {"variant", "solref", "solimp", "solreffriction"},
}
REFUSED["myosuite_walk"] = REFUSED["myoleg"]
"""What each environment does not read whatever the backward mode."""
STATE_EPS = {"fd.eps_qpos", "fd.eps_qvel", "fd.eps_act"}
UNREAD_BY = {
    "tape_per_substep": {"fd.eps_ctrl"} | STATE_EPS,
    "tape_all": {"fd.eps_ctrl"} | STATE_EPS,
    "fd_jacobian": {"substep_grad_clip"},
    "hybrid": STATE_EPS,
}


LEGS = """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body name="root" pos="0 0 .8"><freejoint/>
<geom size=".1" mass="1"/>
<body><joint name="hip_flexion_r"/><geom size=".1" mass="1"/></body>
<body><joint name="hip_flexion_l"/><geom size=".1" mass="1"/></body></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def legs(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The path of a small model for `myoleg`."""
    path = tmp_path_factory.mktemp("legs") / "legs.xml"
    path.write_text(LEGS)
    return str(path)


def _settings(env: str, backward: str, legs: str) -> dict[str, Any]:
    settings: dict[str, Any] = {"env": {"name": env, "control_timestep": 0.02}, "physics": {"backward": backward}}
    if env == "myoleg":
        settings["env"] |= {"model": legs}
    if env == "myosuite_walk":
        settings["env"] |= {"model": walk_model()}
    return settings


@cache
def _model(env: str, field: str | None, legs: str) -> bytes:
    """The compiled model of an environment with one setting of its physics changed."""
    settings = _settings(env, "fd_jacobian", legs)
    config = parse_config(settings if field is None else overlay(settings, {f"physics.{field}": _value(env, field)}))
    model = env_class(config.env).build_model(config.env, config.physics)
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def _value(env: str, field: str) -> Any:
    # These models have MuJoCo's default cone.
    return "elliptic" if field == "cone" and env in ("myoleg", "myosuite_walk") else VALUES[field]


def _backward(config: Config) -> list[tuple[Any, ...]]:
    """What the backward mode, and those it is made of, are told."""
    whole = vars(configured_backward(config.physics))
    parts = [whole, *(vars(whole[name]) for name in ("state", "ctrl") if name in whole)]
    return [(part.get("substep_grad_clip"), part.get("eps")) for part in parts]


def test_every_field_is_tried() -> None:
    # `test_randomize` tries that section.
    fields = {name for name in PhysicsConfig.model_fields if name not in ("fd", "backward", "randomize")}
    assert set(VALUES) == fields | {f"fd.{name}" for name in FdConfig.model_fields}
    assert set(UNREAD_BY) == set(BACKWARD_MODES)


@pytest.mark.parametrize("backward", sorted(UNREAD_BY))
@pytest.mark.parametrize("env", sorted(REFUSED))
def test_a_setting_does_something_or_is_refused(env: str, backward: str, legs: str) -> None:
    base = _settings(env, backward, legs)
    plain = _backward(parse_config(base))
    for field in VALUES:
        settings = overlay(base, {f"physics.{field}": _value(env, field)})
        if field in REFUSED[env] | UNREAD_BY[backward]:
            with pytest.raises(ConfigError) as caught:
                parse_config(settings)
            assert f"physics.{field}:" in str(caught.value)
            assert "leave it out" in str(caught.value)
        elif field == "substep_grad_clip" or field.startswith("fd."):
            assert _backward(parse_config(settings)) != plain, f"{field} does nothing"
        else:
            parse_config(settings)
            assert _model(env, field, legs) != _model(env, None, legs), f"{field} does nothing"


@pytest.mark.parametrize("env", ["ant", "myoleg26"])
@pytest.mark.parametrize("field", ["nconmax", "njmax"])
def test_buffers_are_as_large_as_asked_for(env: str, field: str) -> None:
    config = parse_config(overlay(_settings(env, "tape_all", ""), {f"execution.{field}": 61}))
    execution = config.execution
    batch = make_env(config.env, config.physics, 1, "cpu", 0, differentiable=False, execution=execution).sim.batch
    assert 61 in (batch.data.naconmax, batch.data.njmax)


def test_constraints_are_solved_by_the_kernels_asked_for() -> None:
    execution = {"solver_kernels": "fused", "deterministic": True}
    config = parse_config(_settings("myosuite_walk", "tape_all", "") | {"execution": execution})
    batch = make_env(config.env, config.physics, 2, "cpu", 0, execution=config.execution).sim.batch
    assert batch.kernels == Kernels(ordered=True, fused_solver=True)
    assert not batch.stages.unrolls


@pytest.mark.parametrize(("jacobian", "fused"), [(None, True), ("sparse", False)])
def test_kernels_may_be_chosen_for_the_model(jacobian: str | None, fused: bool) -> None:
    execution = {"solver_kernels": "auto", "jacobian": jacobian}
    config = parse_config(_settings("ant", "tape_all", "") | {"execution": execution})
    batch = make_env(config.env, config.physics, 2, "cpu", 0, execution=config.execution).sim.batch
    assert batch.kernels.fused_solver == fused


@pytest.mark.parametrize(
    ("other", "write"),
    [
        ({"execution.jacobian": "sparse"}, "leave execution.jacobian out"),
        ({"physics.integrator": "RK4"}, "solver_kernels: mujoco_warp"),
    ],
)
def test_what_the_fused_solver_is_not_for_is_refused(other: dict[str, Any], write: str) -> None:
    with pytest.raises(ConfigError, match=write):
        parse_config(overlay({"env": {"name": "ant"}, "execution": {"solver_kernels": "fused"}}, other))
