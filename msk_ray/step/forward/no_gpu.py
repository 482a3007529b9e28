"""Warp's start on a machine without a GPU, where its warnings about CUDA say nothing that anybody asked."""

import os
import sys
import tempfile
from pathlib import Path

import warp as wp

_DEVICES = ("/dev/nvidiactl", "/dev/nvidia0", "/dev/dxg")
"""One of these is there wherever Linux, or WSL, has a driver for CUDA."""
_WARNING = b"Warp CUDA "


def start_quietly() -> None:
    """Initialise Warp without its lines about CUDA, if this machine has no GPU. With one, this does nothing: Warp then
    starts where it is first used, on the devices that are visible there."""
    if sys.platform != "linux" or any(Path(device).exists() for device in _DEVICES):
        return
    try:
        stderr = os.dup(2)
    except OSError:
        return  # closed: nobody would read them
    try:
        with tempfile.TemporaryFile() as kept:
            # They are printed by its library, which has no setting for that.
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
