"""Errors in what a policy observes: in entries of the observation, and in encoders, which servos read too.

Axes: W worlds, O observation, E entries or joints with an error.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase

import mujoco
import torch
from torch import Tensor

from msk_ray.config import Spread
from msk_ray.envs.position_servos import position_servos
from msk_ray.errors import ConfigError, shortened

UNIFORM_BITS = 24
"""Bits of a uniform float32 number in [0, 1)."""
_LISTED = 400
"""Largest number of characters that an error spends on known names."""


class EntryErrors:
    """Errors of some entries of the observation.

    Args:
        setting: name of the setting in `physics.randomize`.
        spreads: its distributions, by name or pattern of entries.
        names: names of all entries.
        device: where observations are.

    Attributes:
        size: number of entries with an error, E.

    Raises:
        ConfigError: a pattern matches no entry, or an entry has two distributions.
    """

    def __init__(
        self, setting: str, spreads: Mapping[str, Spread] | None, names: list[str], device: torch.device
    ) -> None:
        chosen = dict(sorted(_chosen(setting, spreads or {}, names, "entry of the observation")))
        self.size = len(chosen)
        self._entries = torch.tensor(list(chosen), dtype=torch.int64, device=device)
        self._draws = _Draws(list(chosen.values()), device)

    def added(self, obs: Tensor, uniform: Tensor) -> Tensor:
        """Observations (W, O) with errors made from uniform numbers in [0, 1), (W, E)."""
        return obs.index_add(1, self._entries, self._draws.of(uniform))


class EncoderErrors:
    """Errors of the encoders of joints with position servos.

    An encoder with the error b reads q + b where the joint is at q. The policy observes q + b, and the servo, which
    reads the same encoder, brings the joint to its target − b.

    Args:
        spreads: distributions of b [m, rad], by name or pattern of joints.
        model: the model.
        names: names of all entries of the observation; a joint's position is the entry NAME_angle or NAME_position.
        device: where observations and controls are.

    Attributes:
        size: number of joints with an error, E.

    Raises:
        ConfigError: a pattern matches no joint with a position servo, a joint has two distributions, or the observation
            does not show its position.
    """

    def __init__(
        self, spreads: Mapping[str, Spread] | None, model: mujoco.MjModel, names: list[str], device: torch.device
    ) -> None:
        servos = _servos_of_joints(model) if spreads else {}
        joints = sorted(set(servos.values()))
        joint_names = [model.joint(joint).name or str(joint) for joint in joints]
        chosen = dict(sorted(_chosen("encoder_bias", spreads or {}, joint_names, "joint with a position servo")))
        self.size = len(chosen)
        self._draws = _Draws(list(chosen.values()), device)
        to_entries, to_controls = torch.zeros(self.size, len(names)), torch.zeros(self.size, model.nu)
        for row, which in enumerate(chosen):
            entry_names = [f"{joint_names[which]}_{kind}" for kind in ("angle", "position")]
            entries = [entry for entry, name in enumerate(names) if name in entry_names]
            if not entries:
                raise ConfigError(
                    f"physics.randomize.encoder_bias: the observation does not show joint {joint_names[which]!r} as "
                    f"{' or '.join(entry_names)}: name the entry so in observation_layout, or leave the joint out"
                )
            to_entries[row, entries] = 1.0
            for servo, joint in servos.items():
                if joint == joints[which]:
                    to_controls[row, servo] = -float(model.actuator_gear[servo, 0])
        self._to_entries, self._to_controls = to_entries.to(device), to_controls.to(device)

    def added(self, obs: Tensor, uniform: Tensor) -> Tensor:
        """Observations (W, O) with errors made from uniform numbers in [0, 1), (W, E)."""
        return torch.addmm(obs, self._draws.of(uniform), self._to_entries)

    def shifted(self, control: Tensor, uniform: Tensor) -> Tensor:
        """Controls (W, nu) that bring exact servos to where the errors would bring these, from the same numbers."""
        return torch.addmm(control, self._draws.of(uniform), self._to_controls)


class _Draws:
    """E random numbers with mean 0, each with a distribution of its own."""

    def __init__(self, spreads: Sequence[Spread], device: torch.device) -> None:
        self._sizes = torch.tensor([spread.uniform or spread.normal or 0.0 for spread in spreads], device=device)
        normal = [spread.normal is not None for spread in spreads]
        self._normal = torch.tensor(normal, device=device) if any(normal) else None

    def of(self, uniform: Tensor) -> Tensor:
        """The random numbers made from uniform numbers in [0, 1), both (W, E)."""
        share = 2.0 * uniform - 1.0
        if self._normal is not None:
            inside = share.clamp(-1.0 + 2.0**-UNIFORM_BITS, 1.0 - 2.0**-UNIFORM_BITS)
            share = torch.where(self._normal, math.sqrt(2.0) * torch.erfinv(inside), share)
        return self._sizes * share


def _servos_of_joints(model: mujoco.MjModel) -> dict[int, int]:
    """Number of the joint for the number of each position servo of a hinge or slide joint.

    Raises:
        ConfigError: the model has no such servo.
    """
    servo = position_servos(model) & (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT))
    joints = {int(actuator): int(model.actuator_trnid[actuator, 0]) for actuator in servo.nonzero()[0]}
    single = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joints = {actuator: joint for actuator, joint in joints.items() if int(model.jnt_type[joint]) in single}
    if not joints:
        raise ConfigError(
            "physics.randomize.encoder_bias: the model has no position servo of a joint, whose target it could shift: "
            "write observation_bias, for the observation alone"
        )
    return joints


def _chosen(setting: str, spreads: Mapping[str, Spread], names: list[str], kind: str) -> Iterator[tuple[int, Spread]]:
    """Numbers of the named things that patterns match, each with its distribution.

    Args:
        setting: name of the setting in `physics.randomize`.
        spreads: distributions by pattern.
        names: names of all things.
        kind: what they are, for messages.

    Raises:
        ConfigError: a pattern matches nothing, or two match the same thing.
    """
    key, taken = f"physics.randomize.{setting}", dict[int, str]()
    for pattern, spread in spreads.items():
        matching = [i for i, name in enumerate(names) if fnmatchcase(name, pattern)]
        if not matching:
            known = shortened(", ".join(dict.fromkeys(names)), _LISTED)
            raise ConfigError(f"{key}: no {kind} is {pattern!r}; it has {known}")
        for which in matching:
            if which in taken:
                raise ConfigError(f"{key}: {names[which]!r} is both {taken[which]!r} and {pattern!r}; leave one out")
            taken[which] = pattern
            yield which, spread
