"""The base class of searches: a search suggests a trial's values, and gets its result."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar

from msk_ray.errors import ConfigError
from msk_ray.sweep.operators import Operator


class Search(ABC):
    """Suggests trials.

    To write your own, derive a class from this one, and name its import path in a space:
    `search: package.module:Class`.
    """

    packages: ClassVar[Mapping[str, str]] = {}
    """Optional modules that it needs → argument of `pip install`; checked before anything starts."""
    name: ClassVar[str] = ""
    """Name in messages; by default the class name."""
    several_objectives: ClassVar[bool] = False
    """Whether it supports `objectives` instead of the score. Its constructor then gets them as a third argument, metric
    → `minimize` or `maximize`, and results come by `tell_objectives`."""

    def __init__(self, parameters: Mapping[str, Operator], seed: int) -> None:
        """
        Args:
            parameters: dotted key → operator.
            seed: seed of its draws; another one each time an experiment is resumed.

        Raises:
            ConfigError: it does not support one of the operators.
        """
        self.parameters = dict(parameters)
        self.seed = seed

    @abstractmethod
    def ask(self) -> dict[str, Any]:
        """Values of the next trial by dotted key; the label for values of a list."""

    @abstractmethod
    def tell(self, params: Mapping[str, Any], score: float | None) -> None:
        """Record the result of a trial.

        Args:
            params: its values, suggested in this run of the experiment or an earlier one.
            score: its best score; None if it has no score.
        """

    def tell_objectives(self, params: Mapping[str, Any], values: Sequence[float] | None) -> None:
        """Record the result of a trial of a space with `objectives`.

        Args:
            params: as for `tell`.
            values: the objectives at its last evaluation, in order; None if there was none.
        """
        raise NotImplementedError  # only called if `several_objectives`

    @classmethod
    def check(cls, parameters: Mapping[str, Operator], seeds: Collection[int]) -> None:
        """Raise if this search does not support a space.

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
