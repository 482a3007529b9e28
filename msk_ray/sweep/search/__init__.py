"""Searches by name. A search suggests trials one by one as results arrive."""

from msk_ray.config import Registry, resolve_class
from msk_ray.sweep.search.base import Search

SEARCHES = Registry("search", "msk_ray.searches", {"optuna": "msk_ray.sweep.search.tpe:OptunaSearch"})

__all__ = ["SEARCHES", "Search", "search_class"]


def search_class(name: str) -> type[Search]:
    """The class of a search by name or import path.

    Raises:
        ConfigError: there is none.
    """
    # mypy does not accept an abstract class as type[T].
    return resolve_class(SEARCHES.path(name), "search", Search)  # type: ignore[type-abstract]
