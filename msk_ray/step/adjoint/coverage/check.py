"""The check of a model against the table of features before the first step, and the table for the docs."""

import mujoco

from msk_ray.step.adjoint.coverage.features import FEATURES, Feature
from msk_ray.step.errors import UnsupportedModelError


def unsupported(model: mujoco.MjModel) -> dict[str, list[str]]:
    """Elements of `model` by the name of the feature that the adjoint does not differentiate."""
    return {feature.name: elements for feature, elements in _refused(model)}


def _refused(model: mujoco.MjModel) -> list[tuple[Feature, list[str]]]:
    inexact = [(feature, feature.find(model)) for feature in FEATURES if not feature.exact]
    return [(feature, elements) for feature, elements in inexact if elements]


def check_supported(model: mujoco.MjModel, mode: str) -> None:
    """Raise UnsupportedModelError naming every element that `mode` cannot differentiate."""
    refused = _refused(model)
    if refused:
        lines = [f"{feature.name} ({_few(elements)})" for feature, elements in refused]
        instead = [f" Write {feature.instead}." for feature, _ in refused if feature.instead]
        raise UnsupportedModelError(
            f"{mode} does not differentiate {'; '.join(lines)}.{''.join(instead)} Finite differences do: "
            "physics.backward=fd_jacobian in a config, --mode fd_jacobian of gradcheck, backward=FdJacobian() in Python"
        )


def _few(elements: list[str]) -> str:
    return ", ".join(elements[:5]) + (" …" if len(elements) > 5 else "")


def table() -> str:
    """The table as Markdown."""
    rows = ["| feature | gradient | note |", "|---|---|---|"]
    for f in FEATURES:
        kept = "exact, approximated where counted" if f.counted else "exact"
        rows.append(f"| {f.name} | {kept if f.exact else 'raises'} | {f.note} |")
    return "\n".join(rows)
