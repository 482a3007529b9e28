"""What a trial prints, in a file of limited size."""

import os
from pathlib import Path

import pytest

from msk_ray.tune import output
from msk_ray.tune.output import limit_output


def test_the_middle_of_much_output_is_left_out_and_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, size in (("LIMIT", 1 << 20), ("KEPT_FIRST", 100), ("KEPT_LAST", 200)):
        monkeypatch.setattr(output, name, size)
    path = tmp_path / "output.log"
    # As another process of the trial, which has opened it before.
    other = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for round_ in range(3):
        os.write(other, b"first of all\n" + b"x" * (1 << 20))
        os.write(other, b"last of round %d\n" % round_)
        limit_output(path)
        text = path.read_text()
        assert len(text) < 500
        assert text.startswith("first of all\n")
        assert text.endswith(f"last of round {round_}\n")
        assert text.count("more than 1 MiB were printed; what came here is left out") == 1
    os.write(other, b"and on\n")
    os.close(other)
    limit_output(path)
    assert path.read_text().endswith("last of round 2\nand on\n")
