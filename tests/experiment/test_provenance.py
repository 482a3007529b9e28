"""Versions kept beside results."""

from importlib import metadata

from msk_ray.experiment.provenance import installed_versions


def test_what_is_not_installed_is_left_out() -> None:
    assert installed_versions(["torch", "no-such-package"]) == {"torch": metadata.version("torch")}
