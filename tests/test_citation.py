"""What a release says of itself agrees everywhere."""

import re
from pathlib import Path

import yaml

import msk_ray


def test_the_version_is_the_same_everywhere(root: Path) -> None:
    citation = yaml.safe_load((root / "docs" / "CITATION.cff").read_text())
    assert citation["version"] == msk_ray.__version__
    assert f"version = {{{msk_ray.__version__}}}" in (root / "docs" / "cite.md").read_text()
    latest = re.search(r"^## (\S+)", (root / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert latest is not None
    assert latest[1] == msk_ray.__version__
    images = re.findall(r"/msk_ray:([\d.]+)", "".join(p.read_text() for p in (root / "cluster").glob("*.yaml")))
    assert set(images) == {msk_ray.__version__}
