"""What nvidia-smi answers, by programs that stand in for it."""

from pathlib import Path

import pytest

from msk_ray.nvidia_smi import DriverView, ask_driver

NONE = DriverView(None, ())
LONG_S = 500.0
"""For a program that answers: a busy machine may take seconds to start it."""


@pytest.mark.parametrize(
    ("script", "limit_s", "expected"),
    [
        (
            "echo '570.1, NVIDIA H200'; echo '570.1, NVIDIA L4, big'",
            LONG_S,
            DriverView("570.1", ("NVIDIA H200", "NVIDIA L4, big")),
        ),
        ("echo 'NVIDIA-SMI has failed because it could not talk to the driver'; exit 9", LONG_S, NONE),
        ("echo 'No devices were found'", LONG_S, NONE),
        ("exec /bin/sleep 1000", 0.1, DriverView("that does not answer", ())),
    ],
)
def test_what_the_driver_says(
    script: str, limit_s: float, expected: DriverView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "nvidia-smi"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert ask_driver(timeout_s=limit_s) == expected


def test_no_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert ask_driver() == NONE
