"""Silences Warp's warnings about CUDA on machines without a GPU."""

import os
import sys
import tempfile
from pathlib import Path

import warp as wp

_DEVICES = ("/dev/nvidiactl", "/dev/nvidia0", "/dev/dxg")
"""One of these exists wherever Linux or WSL has a CUDA driver."""
_WARNING = b"Warp CUDA "


def start_quietly() -> None:
    """Initialise Warp without its lines about CUDA, if this machine has no GPU. With a GPU, do nothing: Warp then
    starts at its first use, with the devices visible by then."""
    if sys.platform != "linux" or any(Path(device).exists() for device in _DEVICES):
        return
    try:
        stderr = os.dup(2)
    except OSError:
        return  # stderr is closed
    try:
        with tempfile.TemporaryFile() as kept:
            # Warp's native library prints them, without a setting to turn it off.
            os.dup2(kept.fileno(), 2)
            try:
                wp.init()
            finally:
                os.dup2(stderr, 2)
                kept.seek(0)
                for line in kept:
                    if not line.startswith(_WARNING):
                        os.write(2, line)
    finally:
        os.close(stderr)
