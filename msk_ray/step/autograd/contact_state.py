"""What named parts of a model touched in the substeps of an env step, and for how long; without gradient.

Axes: S substeps, W worlds, n named parts.
"""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from msk_ray.step.autograd.kinematics import Kinematics, Names
from msk_ray.step.errors import ConfigError
from msk_ray.step.forward.contact_watch import ContactQuery, geoms_of

_ROUNDING = 1e-6
"""Allowance for the rounding of summed timesteps [s]."""


class Contact(NamedTuple):
    """Contacts of n parts in the substeps of an env step; values without gradient, the last substep's in front."""

    force: Tensor
    """Sum of the contacts' forces on each part in the last substep, world coordinates [N], (W, n, 3)."""
    number: Tensor
    """Number of its contacts in the last substep, (W, n)."""
    strongest: Tensor
    """Largest force of one contact [N] in each substep, (S, W, n)."""
    touching: Tensor
    """Whether there is a contact, in each substep, bool (S, W, n)."""

    @classmethod
    def of(cls, figures: Tensor) -> Self:
        """From the answer of a `ContactWatch`, (S, W, n, 5)."""
        return cls(figures[-1, ..., :3], figures[-1, ..., 3], figures[..., 4], figures[..., 3] > 0.0)

    def without(self, worlds: Tensor) -> Self:
        """The same, but no contact in these `worlds`, bool (W,)."""
        parts = (self.number, self.strongest, self.touching)
        cut = (part.masked_fill(worlds[:, None], 0) for part in parts)
        return type(self)(self.force.masked_fill(worlds[:, None, None], 0.0), *cut)


class ContactQueries:
    """Queries about named parts of a model, each made once.

    Args:
        kinematics: the model's.
    """

    def __init__(self, kinematics: Kinematics) -> None:
        self._kinematics = kinematics
        self._made: dict[tuple[object, ...], ContactQuery] = {}

    def __call__(self, names: Names, kind: str = "geom", against: Names = 0, by: str = "subtree") -> ContactQuery:
        """The query about contacts of some parts.

        Args:
            names: one or n parts, by names or ids.
            kind: what they are: `geom`, `body`, `site` (its body) or `subtree` (of a body).
            against: the other side of the contacts, one part or several together; by default everything.
            by: kind of the other side.

        Raises:
            ConfigError: the model has no such part, or there is no such kind.
        """
        primary, secondary = _several(names), _several(against)
        key = (primary, kind, secondary, by)
        if key not in self._made:
            others = {geom for name in secondary for geom in self._geoms(by, name)}
            groups = tuple(self._geoms(kind, name) for name in primary)
            self._made[key] = ContactQuery(groups, tuple(sorted(others)))
        return self._made[key]

    def _geoms(self, kind: str, name: str | int) -> tuple[int, ...]:
        if kind not in ("geom", "body", "site", "subtree"):
            raise ConfigError(f"contacts of a {kind!r}: write 'geom', 'body', 'site' or 'subtree'")
        element = "body" if kind == "subtree" else kind
        return geoms_of(self._kinematics.model, kind, self._kinematics.id(element, name))


def _several(names: Names) -> tuple[str | int, ...]:
    return (names,) if isinstance(names, str | int) else tuple(names)


class AirTime(NamedTuple):
    """How long n parts have touched nothing, or something; each (W, n) [s].

    A pure record, for a memory of 4 n numbers: `AirTime.of(memory).after(touching, timestep).memory`.
    """

    air: Tensor
    """Time since the last contact; 0 in contact."""
    contact: Tensor
    """Time since the contact began; 0 in the air."""
    last_air: Tensor
    """How long the last time in the air was, when it had ended."""
    last_contact: Tensor
    """How long the last contact was, when it had ended."""

    @classmethod
    def of(cls, memory: Tensor) -> Self:
        """From a memory (W, 4 n), zero at the start."""
        return cls(*memory.chunk(4, -1))

    @property
    def memory(self) -> Tensor:
        """All of it in one tensor, (W, 4 n)."""
        return torch.cat(self, -1)

    def after(self, touching: Tensor, timestep: float) -> "AirTime":
        """The record after the substeps of `touching`, bool (S, W, n), each of `timestep` [s]."""
        now = self
        for touches in touching:
            air, contact = now.air + timestep, now.contact + timestep
            now = AirTime(
                air.masked_fill(touches, 0.0),
                contact.masked_fill(~touches, 0.0),
                torch.where(touches & (now.air > 0.0), air, now.last_air),
                torch.where(~touches & (now.contact > 0.0), contact, now.last_contact),
            )
        return now

    def first_contact(self, duration: float) -> Tensor:
        """Whether the contact began within the last `duration` [s], bool (W, n)."""
        return (self.contact > 0.0) & (self.contact < duration + _ROUNDING)
