"""Parameters of the model that differ between worlds and change with every episode.

Axes: W worlds, K numbers that are drawn per world and episode.
"""

import math
from collections.abc import Iterable, Mapping
from operator import attrgetter
from typing import Any, NamedTuple, Self

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msk_ray.config import Draw, Payload, RandomizeConfig, Shift
from msk_ray.envs.friction import friction_without_effect
from msk_ray.envs.generators import seed_stream
from msk_ray.envs.position_servos import position_servos
from msk_ray.errors import ConfigError


class _Field(NamedTuple):
    """What one setting changes."""

    arrays: tuple[str, ...]
    """Names of the model's arrays."""
    element: str | None
    """Kind of their elements, which have names; None: the array has none."""
    columns: slice = slice(None)
    """Entries of an element that change."""


_FIELDS = {
    "geom_friction": _Field(("geom_friction",), "geom", slice(0, 1)),
    "pair_friction": _Field(("pair_friction",), "pair", slice(0, 2)),
    "body_mass": _Field(("body_mass", "body_inertia"), "body"),
    "payload": _Field(("body_mass",), "body"),
    "body_ipos": _Field(("body_ipos",), "body"),
    "dof_damping": _Field(("dof_damping",), "joint"),
    "dof_armature": _Field(("dof_armature",), "joint"),
    "dof_frictionloss": _Field(("dof_frictionloss",), "joint"),
    "jnt_stiffness": _Field(("jnt_stiffness",), "joint"),
    "actuator_gear": _Field(("actuator_gear",), "actuator"),
    "actuator_gain": _Field(("actuator_gainprm", "actuator_biasprm"), "actuator", slice(0, 3)),
    "actuator_kp": _Field(("actuator_gainprm", "actuator_biasprm"), "actuator"),
    "actuator_kd": _Field(("actuator_biasprm",), "actuator"),
    "gravity": _Field(("opt.gravity",), None),
    "gravity_shift": _Field(("opt.gravity",), None),
}


_SERVO_COLUMNS = {
    "actuator_kp": {"actuator_gainprm": 0, "actuator_biasprm": 1},
    "actuator_kd": {"actuator_biasprm": 2},
}
"""Where MuJoCo has stiffness and damping of a position servo."""

_STREAM = 1

AnyDraw = Draw | Payload | Shift


class _Linear(NamedTuple):
    """One array as a function of the numbers."""

    const: NDArray[np.float64]
    slope: NDArray[np.float64]
    set_by: NDArray[np.object_]
    """Setting that scales or replaces each entry; empty if none does."""

    @classmethod
    def of(cls, base: NDArray[np.float64], numbers: int) -> Self:
        """The model's array, which no number changes yet."""
        return cls(base.copy(), np.zeros((numbers, *base.shape)), np.full(base.shape, "", dtype=object))

    def vary(self, name: str, draw: AnyDraw, at: Any, first: int) -> None:
        """Let the numbers from the one numbered `first` on change the entries `at`, as the setting `name` says.

        Raises:
            ConfigError: another setting scales or replaces them.
        """
        if isinstance(draw, Shift):
            axes = len(draw.size)
            self.slope[first : first + axes][(slice(None), *np.index_exp[at])] = np.eye(axes)
        elif isinstance(draw, Payload):
            self.slope[first][at] = 1.0
        else:
            if other := next(filter(None, np.ravel(self.set_by[at])), None):
                raise ConfigError(f"physics.randomize: {other} includes {name}; leave one of both out")
            self.slope[first][at] = self.const[at] if draw.mode == "scale" else 1.0
            self.const[at] = 0.0
            self.set_by[at] = name


class Randomizer:
    """Draws the numbers of a `randomize` section for every world, and turns them into parameters of the model.

    An array is linear in the numbers: const + drawn · slope. A scaled entry has its value in the slope, a replaced one
    has 1 there, and every other has its value in const, those that something is added to also 1 in the slope.

    Args:
        config: the section.
        model: the model, with the values that scales refer to.
        device: where the parameters are needed.
        seed: the environment's; the generator is another one, with another seed made from this, so that initial states
            are those of a trial without randomization and tell nothing of the numbers.

    Attributes:
        generator: source of the numbers.
        parameters: names of the fields of the model that it sets.
        size: K.

    Raises:
        ConfigError: the model has no such elements, or a number would have no effect.
    """

    def __init__(self, config: RandomizeConfig, model: mujoco.MjModel, device: torch.device, seed: int) -> None:
        self.generator = torch.Generator(device=device)
        self.seed(seed)
        self._device = device
        chosen = {name: _chosen(model, name, draw) for name, draw in config.parameters.items()}
        owners = {name: _owners(model, name, rows) for name, rows in chosen.items()}
        every = [
            (name, _bounds(draw) * (len(set(owners[name])) if draw.each else 1))
            for name, draw in config.parameters.items()
        ]
        self._widths = {name: len(bounds) for name, bounds in every}
        bounds = [bound for _, of_name in every for bound in of_name]
        self._low, high, log = (self._tensor(part) for part in zip(*bounds, strict=True))
        self._span = high - self._low
        self.size = len(self._low)
        self._log = log.bool() if log.any() else None
        linear = self._arrays(config, model, chosen, owners)
        # All arrays side by side: one product gives them all.
        self._const, self._slope = (torch.cat(parts, dim=-1) for parts in zip(*linear.values(), strict=True))
        self._shapes = {name: attrgetter(name)(model).shape for name in linear}
        self.parameters = tuple(self._shapes)

    def seed(self, seed: int) -> None:
        """Draw from now on as after construction with this seed, the environment's."""
        seed_stream(self.generator, seed, _STREAM)

    def draw(self, count: int) -> Tensor:
        """Numbers of `count` episodes, (count, K)."""
        uniform = torch.rand((count, len(self._low)), generator=self.generator, device=self._device)
        drawn = torch.addcmul(self._low, self._span, uniform)
        return drawn if self._log is None else torch.where(self._log, drawn.exp(), drawn)

    def metrics(self, numbers: Tensor) -> dict[str, float]:
        """Smallest and largest of the numbers (W, K) of each setting, by metric name."""
        figures: dict[str, float] = {}
        for name, part in zip(self._widths, numbers.split(list(self._widths.values()), dim=1), strict=True):
            figures |= {f"randomize/{name}_min": float(part.min()), f"randomize/{name}_max": float(part.max())}
        return figures

    def values(self, numbers: Tensor) -> dict[str, Tensor]:
        """Values of fields of the model by name, with a row for each of the W worlds with the numbers (W, K)."""
        every = torch.addmm(self._const, numbers, self._slope)
        parts = every.split([math.prod(shape) for shape in self._shapes.values()], dim=1)
        return {name: part.unflatten(1, shape) for (name, shape), part in zip(self._shapes.items(), parts, strict=True)}

    def _arrays(
        self,
        config: RandomizeConfig,
        model: mujoco.MjModel,
        chosen: Mapping[str, list[int]],
        owners: Mapping[str, list[int]],
    ) -> dict[str, tuple[Tensor, Tensor]]:
        """(const (n,), slope (K, n)) of every array with n entries."""
        linear: dict[str, _Linear] = {}
        first = 0
        for name, draw in config.parameters.items():
            field = _FIELDS[name]
            step = len(_bounds(draw)) if draw.each else 0
            places = {owner: first + step * k for k, owner in enumerate(dict.fromkeys(owners[name]))}
            for array in field.arrays:
                base = np.array(attrgetter(array)(model), dtype=np.float64)
                if array not in linear:
                    linear[array] = _Linear.of(base, len(self._low))
                for element, owner in zip(chosen[name], owners[name], strict=True):
                    at = _entries(model, name, array, element, base.ndim)
                    linear[array].vary(name, draw, at, places[owner])
            first += self._widths[name]
        return {
            array: (self._tensor(const.ravel()), self._tensor(slope.reshape(len(slope), -1)))
            for array, (const, slope, _) in linear.items()
        }

    def _tensor(self, values: Any) -> Tensor:
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=self._device)


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of all elements of a kind; nameless ones by number."""
    kinds = mujoco.mjtObj
    of = {
        "geom": (kinds.mjOBJ_GEOM, model.ngeom),
        "pair": (kinds.mjOBJ_PAIR, model.npair),
        "body": (kinds.mjOBJ_BODY, model.nbody),
        "joint": (kinds.mjOBJ_JOINT, model.njnt),
        "actuator": (kinds.mjOBJ_ACTUATOR, model.nu),
    }
    obj, count = of[kind]
    return [mujoco.mj_id2name(model, obj, i) or str(i) for i in range(count)]


def _bounds(draw: AnyDraw) -> list[tuple[float, float, bool]]:
    """Bounds of each uniform number that is drawn for one element or all, and whether it is a logarithm."""
    if isinstance(draw, Shift):
        return [(-size, size, False) for size in draw.size]
    log = isinstance(draw, Draw) and draw.distribution == "log_uniform"
    return [(math.log(draw.low), math.log(draw.high), True) if log else (draw.low, draw.high, False)]


def _entries(model: mujoco.MjModel, name: str, array: str, element: int, axes: int) -> Any:
    """Index of the entries of an element that change, in an array of `axes` axes."""
    if _FIELDS[name].element is None:
        return slice(None)
    return element if axes == 1 else (element, _columns(model, name, array, element))


def _columns(model: mujoco.MjModel, name: str, array: str, element: int) -> slice:
    """Entries of an element that change, in an array with several for each."""
    if name in _SERVO_COLUMNS:
        first = _SERVO_COLUMNS[name][array]
        return slice(first, first + 1)
    if name == "actuator_gain" and model.actuator_gaintype[element] == mujoco.mjtGain.mjGAIN_MUSCLE:
        return slice(2, 4)  # peak force, and the scale that it is computed from if it is not given
    return _FIELDS[name].columns


def _owners(model: mujoco.MjModel, name: str, elements: Iterable[int]) -> list[int]:
    """The element that each row of a field's arrays belongs to: for dofs their joint."""
    if name.startswith("dof_"):
        return [int(model.dof_jntid[dof]) for dof in elements]
    return list(elements)


def _chosen(model: mujoco.MjModel, name: str, draw: AnyDraw) -> list[int]:
    """Rows of a field's arrays that change.

    Raises:
        ConfigError: there are none, or no number would have an effect on them.
    """
    field, key = _FIELDS[name], f"physics.randomize.{name}"
    if field.element is None:
        if draw.only is not None or draw.each:
            raise ConfigError(f"{key}: it belongs to the whole model; leave out only and each")
        rows = [0]
    else:
        names = _names(model, field.element)
        unknown = [n for n in draw.only or () if n not in names]
        if unknown:
            raise ConfigError(f"{key}.only: the model has no {field.element} {unknown[0]!r}; it has {', '.join(names)}")
        wanted = {i for i, n in enumerate(names) if draw.only is None or n in draw.only}
        base = attrgetter(field.arrays[0])(model)
        rows = [row for row, owner in enumerate(_owners(model, name, range(len(base)))) if owner in wanted]
        if name in _SERVO_COLUMNS:
            servos = position_servos(model)
            rows = [row for row in rows if servos[row]]
        if not rows:
            raise ConfigError(f"{key}: the model has no {field.element} whose value could be drawn; leave it out")
    _refuse_without_effect(model, name, draw, rows)
    return rows


def _refuse_without_effect(model: mujoco.MjModel, name: str, draw: AnyDraw, rows: list[int]) -> None:
    field, key = _FIELDS[name], f"physics.randomize.{name}"
    if not isinstance(draw, Draw):
        return
    base = np.asarray(attrgetter(field.arrays[0])(model))
    if name == "actuator_kd":
        base = base[:, _SERVO_COLUMNS[name][field.arrays[0]]]
    if draw.mode == "scale" and not np.any(base if field.element is None else base[rows]):
        hint = "leave it out" if type(draw) is not Draw else "write mode: value"
        raise ConfigError(f"{key}: it is 0 in the model, which a scale does not change; {hint}")
    if name == "geom_friction" and (why := friction_without_effect(model, draw, rows)) is not None:
        raise ConfigError(f"{key}: {why}")
    if name == "pair_friction" and (model.pair_dim[rows] == 1).all():
        raise ConfigError(f"{key}: these pairs have no friction (condim 1); leave it out")
