"""What surrounds the recording of a CUDA graph, with captures that only note when they begin and end."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from msk_ray.step.autograd import capture


def test_no_garbage_is_collected_until_torchs_capture_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp's capture ends first. An array that is collected after that is freed at once, which spoils torch's."""
    seen: list[tuple[str, bool]] = []

    @contextmanager
    def noting(whose: str) -> Iterator[list[Any]]:
        seen.append((f"{whose} begins", gc.isenabled()))
        yield []
        seen.append((f"{whose} ends", gc.isenabled()))

    monkeypatch.setattr(torch.cuda, "CUDAGraph", object)
    monkeypatch.setattr(torch.cuda, "device", nullcontext)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph, **options: noting("torch's"))
    monkeypatch.setattr(capture, "stream_of", lambda device: "warp's stream")
    monkeypatch.setattr(capture, "joining_capture", lambda stream: noting("Warp's"))
    recording = capture.Recording(lambda: 7, SimpleNamespace(device="cuda:0"))  # type: ignore[arg-type]
    assert recording.result == 7
    assert seen == [(event, False) for event in ("torch's begins", "Warp's begins", "Warp's ends", "torch's ends")]
    assert gc.isenabled()
