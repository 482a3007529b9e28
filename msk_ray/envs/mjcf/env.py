"""`MjcfEnv`: an environment from an MJCF file.

Axes: W worlds, O observation, A action.
"""

import sys
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

import mujoco
import numpy as np
from torch import Tensor

from msk_ray.config import PhysicsConfig
from msk_ray.envs.base import Env
from msk_ray.envs.mjcf.config import MjcfSettings
from msk_ray.envs.options import override_options
from msk_ray.errors import ConfigError, shortened
from msk_ray.step import StepState

AnyMjcfSettings = TypeVar("AnyMjcfSettings", bound=MjcfSettings)


class MjcfEnv(Env[AnyMjcfSettings], Generic[AnyMjcfSettings]):
    """A model from an MJCF file; a subclass defines the observation and the reward.

    The subclass needs `mjcf`, `reward_names`, `observe` and `reward_terms`, and settings with its own reward:

        class Settings(MjcfEnv.Settings):
            reward: WalkerReward = WalkerReward()

    Actions in [-1, 1] are mapped to each actuator's ctrlrange (`control`), episodes start near a keyframe
    (`draw_physics`) and end at the time limit or when `fell` says so. `edit` may change the model before it is
    compiled. Create constants on the device in `prepare`.

    Observation and reward may use the state's (qpos, qvel, act), `frames` and `tendons`, all with gradients; the
    reward may also use `contact_forces`, which have none.

    Raises:
        ConfigError: the model cannot be read, has no keyframe of that name, or does not fit the settings.
    """

    Settings = MjcfSettings
    mjcf: ClassVar[str]
    """Path of the model's file, relative to the folder of the class that sets it; or the MJCF text itself."""

    @classmethod
    def build_model(cls, config: AnyMjcfSettings, physics: PhysicsConfig) -> mujoco.MjModel:
        source, spec = cls._read(config)
        if physics.timestep is None and physics.substeps is None:
            substeps = _whole_substeps(source, spec.option.timestep, config.control_timestep)
        else:
            substeps = physics.resolve_substeps(config.control_timestep)
        spec.option.timestep = config.control_timestep / substeps
        override_options(spec, physics)
        cls.edit(spec, config, physics)
        try:
            return spec.compile()
        except ValueError as error:
            raise ConfigError(f"{source}: {' '.join(str(error).split())}") from error

    @classmethod
    def edit(cls, spec: mujoco.MjSpec, config: AnyMjcfSettings, physics: PhysicsConfig) -> None:
        """Change the model before it is compiled, for a named physics or for further settings."""

    @classmethod
    def _read(cls, config: AnyMjcfSettings) -> tuple[str, mujoco.MjSpec]:
        """The model's file, or a name for it in messages, and its specification."""
        owner = next((base for base in cls.__mro__ if "mjcf" in vars(base)), None)
        if owner is None:
            raise ConfigError(f"{cls.__qualname__} has no model: write `mjcf = 'model.xml'` in the class")
        text = config.model or owner.mjcf  # type: ignore[attr-defined]
        try:
            if text.lstrip().startswith("<"):
                return f"mjcf of {owner.__qualname__}", mujoco.MjSpec.from_string(text)
            path = _folder_of(owner) / text
            if not path.is_file():
                key = "env.model" if config.model else f"mjcf of {owner.__qualname__}"
                raise ConfigError(f"{key}: no file {path}; write a path relative to {path.parent}, or an absolute one")
            return str(path), mujoco.MjSpec.from_file(str(path))
        except ValueError as error:
            raise ConfigError(f"{shortened(text)}: {' '.join(str(error).split())}") from error

    @cached_property
    def _start(self) -> StepState:
        """The state in which episodes start, without the noise, each part (1, n)."""
        model, name = self.model, self.config.keyframe
        data = mujoco.MjData(model)
        if name is not None:
            known = [model.key(i).name for i in range(model.nkey)]
            if name not in known:
                raise ConfigError(
                    f"env.keyframe: the model has no keyframe {name!r}; it has {', '.join(known) or 'none'}"
                )
            mujoco.mj_resetDataKeyframe(model, data, known.index(name))
        elif model.nkey:
            mujoco.mj_resetDataKeyframe(model, data, 0)
        _check_mocap(data)
        mujoco.mj_normalizeQuat(model, data.qpos)
        return StepState(*(self.tensor(part)[None] for part in (data.qpos, data.qvel, data.act)))

    @cached_property
    def _ranges(self) -> tuple[Tensor, Tensor]:
        """Smallest and largest qpos (nq,) of an initial state; infinite where no joint limits it."""
        model = self.model
        start = self._start.qpos[0].cpu().numpy()
        bounds = np.tile(np.array([[-np.inf], [np.inf]]), model.nq)
        sliding = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
        for joint in range(model.njnt):
            if model.jnt_limited[joint] and model.jnt_type[joint] in sliding:
                at = model.jnt_qposadr[joint]
                low, high = model.jnt_range[joint]
                bounds[:, at] = min(low, start[at]), max(high, start[at])
        return self.tensor(bounds[0]), self.tensor(bounds[1])

    def draw_physics(self, count: int) -> StepState:
        qpos, qvel, act = self._start
        shift = self.config.reset_noise * self.uniform(count, self.model.nv)
        moved = self.sim.tangent.integrate(qpos.repeat(count, 1), shift)
        speed = self.config.reset_velocity_noise * self.uniform(count, self.model.nv)
        return StepState(moved.clamp(*self._ranges), qvel + speed, act.repeat(count, 1))

    @cached_property
    def _control_range(self) -> tuple[Tensor, Tensor]:
        """Middle and half width of each actuator's ctrlrange, (nu,)."""
        model = self.model
        free = [model.actuator(i).name or str(i) for i in range(model.nu) if not model.actuator_ctrllimited[i]]
        if free:
            raise ConfigError(
                f"actuator {free[0]} has no ctrlrange, so no control for actions of -1 and 1: write a ctrlrange in the "
                f"MJCF, or a method `control` in {type(self).__qualname__}"
            )
        low, high = model.actuator_ctrlrange.T
        return self.tensor((low + high) / 2.0), self.tensor((high - low) / 2.0)

    def control(self, action: Tensor) -> Tensor:
        middle, half = self._control_range
        return middle + half * action


def _check_mocap(data: mujoco.MjData) -> None:
    """Raise ConfigError if a keyframe loaded into `data` moves a mocap body, which the simulation holds still."""
    model = data.model
    for body in np.flatnonzero(model.body_mocapid >= 0):
        slot = model.body_mocapid[body]
        pose = np.r_[data.mocap_pos[slot], data.mocap_quat[slot]]
        if not np.allclose(pose, np.r_[model.body_pos[body], model.body_quat[body]]):
            raise ConfigError(
                f"the keyframe moves mocap body {model.body(body).name or body}, which stays where the model puts it: "
                "write mpos and mquat of the keyframe as pos and quat of the body"
            )


def _whole_substeps(source: str, timestep: float, control_timestep: float) -> int:
    substeps = max(1, round(control_timestep / timestep))
    if abs(control_timestep / timestep - substeps) > 1e-4 * substeps:
        raise ConfigError(
            f"the timestep of {source}, {timestep:g} s, does not divide env.control_timestep {control_timestep:g} s: "
            f"write physics.substeps: {substeps}, or env.control_timestep: {substeps * timestep:.8g}"
        )
    return substeps


def _folder_of(owner: type) -> Path:
    """The folder of the file that defines a class; the current folder if the class was typed in."""
    file = getattr(sys.modules.get(owner.__module__), "__file__", None)
    return Path(file).resolve().parent if file else Path.cwd()
