"""The base of searches: a search suggests a trial's values, and is told the result."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar

from msk_ray.errors import ConfigError
from msk_ray.sweep.operators import Operator


class Search(ABC):
    """Suggests trials.

    One of your own is a class derived from this one, named in a space by its import path:
    `search: package.module:Class`.
    """

    packages: ClassVar[Mapping[str, str]] = {}
    """Optional modules that it needs, and what `pip install` takes for each: looked for before anything starts."""
    name: ClassVar[str] = ""
    """Name in messages; by default that of the class."""
    several_objectives: ClassVar[bool] = False
    """Whether it takes `objectives` instead of the score: it is then made with them as a third argument, metric →
    `minimize` or `maximize`, and told by `tell_objectives`."""

    def __init__(self, parameters: Mapping[str, Operator], seed: int) -> None:
        """
        Args:
            parameters: dotted key → the values it may have.
            seed: seed of its draws, a new one each time an experiment is resumed.

        Raises:
            ConfigError: it cannot search such values.
        """
        self.parameters = dict(parameters)
        self.seed = seed

    @abstractmethod
    def ask(self) -> dict[str, Any]:
        """The values of the next trial, by dotted key; for listed values, their label."""

    @abstractmethod
    def tell(self, params: Mapping[str, Any], score: float | None) -> None:
        """Take the result of a trial into account.

        Args:
            params: its values, suggested in this run of the experiment or an earlier one.
            score: its best score; None if it has none.
        """

    def tell_objectives(self, params: Mapping[str, Any], values: Sequence[float] | None) -> None:
        """Take the result of a trial into account, where the space has several objectives.

        Args:
            params: as for `tell`.
            values: at its last evaluation, one for each objective, in order; None if it has none.
        """
        raise NotImplementedError  # only of a search with `several_objectives`

    @classmethod
    def check(cls, parameters: Mapping[str, Operator], seeds: Collection[int]) -> None:
        """Refuse a space that cannot be searched.

        Raises:
            ConfigError: the message says what to write.
        """
        name = cls.name or cls.__name__
        grids = [key for key, op in parameters.items() if op.enumerated]
        if grids:
            raise ConfigError(f"parameters.{grids[0]}.grid: search: {name} cannot enumerate; write choice instead")
        if not parameters:
            raise ConfigError(f"search: {name} needs parameters with choice, uniform, loguniform or randint")
        if len(seeds) > 1:
            raise ConfigError(f"search: {name} runs every suggestion once; write a single seed")
