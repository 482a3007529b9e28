"""The searches, which suggest trials one by one as results come in, by name."""

from msk_ray.config import Registry, resolve_class
from msk_ray.sweep.search.base import Search

SEARCHES = Registry("search", "msk_ray.searches", {"optuna": "msk_ray.sweep.search.tpe:OptunaSearch"})

__all__ = ["SEARCHES", "Search", "search_class"]


def search_class(name: str) -> type[Search]:
    """The class of a search, by its name or import path.

    Raises:
        ConfigError: there is none.
    """
    # mypy takes no abstract class where a class is asked for.
    return resolve_class(SEARCHES.path(name), "search", Search)  # type: ignore[type-abstract]
