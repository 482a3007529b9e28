"""What a search is: it suggests a trial's values, and is told what came of them."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import Any, ClassVar

from msk_ray.errors import ConfigError
from msk_ray.sweep.operators import Operator


class Search(ABC):
    """Suggests trials.

    One of your own is a class derived from this one, named in a space by its import path:
    `search: package.module:Class`.
    """

    name: ClassVar[str] = ""
    """In messages; by default the class's."""

    def __init__(self, parameters: Mapping[str, Operator], seed: int) -> None:
        """
        Args:
            parameters: dotted key → the values it may have.
            seed: of its draws; another one each time an experiment goes on.

        Raises:
            ConfigError: what it needs is not installed, or it cannot search such values.
        """
        self.parameters = dict(parameters)
        self.seed = seed

    @abstractmethod
    def ask(self) -> dict[str, Any]:
        """The values of the next trial, by dotted key; of listed values their label."""

    @abstractmethod
    def tell(self, params: Mapping[str, Any], score: float | None) -> None:
        """Take in what came of a trial.

        Args:
            params: its values, suggested now or when the experiment ran before.
            score: its best one; None if it has none.
        """

    @classmethod
    def check(cls, parameters: Mapping[str, Operator], seeds: Collection[int]) -> None:
        """Refuse a space that cannot be searched.

        Raises:
            ConfigError: saying what to write.
        """
        name = cls.name or cls.__name__
        grids = [key for key, op in parameters.items() if op.enumerated]
        if grids:
            raise ConfigError(f"parameters.{grids[0]}.grid: search: {name} cannot enumerate; write choice instead")
        if not parameters:
            raise ConfigError(f"search: {name} needs parameters with choice, uniform, loguniform or randint")
        if len(seeds) > 1:
            raise ConfigError(f"search: {name} runs every suggestion once; give a single seed")
