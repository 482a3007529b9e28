"""Finding the elements of a model that use a feature, and their names."""

from collections.abc import Callable, Iterable

import mujoco
import numpy as np

Finder = Callable[[mujoco.MjModel], list[str]]
"""Names of the elements of a model that use a feature; none where it does not."""


def named(model: mujoco.MjModel, kind: mujoco.mjtObj, word: str, ids: Iterable[int]) -> list[str]:
    """Elements by their names, or numbers where they have none."""
    return [f"{word} {mujoco.mj_id2name(model, kind, int(i)) or int(i)}" for i in ids]


def among(values: np.ndarray, kinds: Iterable[int]) -> np.ndarray:
    """Which values are of some kinds."""
    return np.isin(values, [int(k) for k in kinds])


def where(kind: mujoco.mjtObj, word: str, test: Callable[[mujoco.MjModel], np.ndarray]) -> Finder:
    """Elements for which a test is true."""
    return lambda model: named(model, kind, word, np.flatnonzero(test(model)))


def option(present: Callable[[mujoco.MjModel], bool], text: str) -> Finder:
    """A text where an option is present."""
    return lambda model: [text] if present(model) else []
