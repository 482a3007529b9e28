"""Torch's part of trials that repeat bit for bit: `execution.deterministic`."""

import os

import torch

from msk_ray.config import Config
from msk_ray.errors import ConfigError

_WORKSPACE = "CUBLAS_WORKSPACE_CONFIG"
_SIZES = (":4096:8", ":16:8")
"""With these workspaces cuBLAS gives the same results on several streams."""
_here = False
"""Whether this module has switched torch's deterministic algorithms on."""


def use_determinism(config: Config, device: str) -> None:
    """Switch torch to algorithms that repeat bit for bit if the trial wants them, otherwise back to its previous ones.

    Raises:
        ConfigError: CUDA has started in this process with a workspace of cuBLAS that does not repeat.
    """
    global _here
    wanted = config.execution.deterministic
    if wanted and device != "cpu" and os.environ.get(_WORKSPACE) not in _SIZES:
        # cuBLAS reads the variable at the first matrix product; memory is allocated by then.
        if torch.cuda.is_initialized() and torch.cuda.memory_reserved(device) > 0:
            raise ConfigError(
                f"execution.deterministic: CUDA runs already without {_WORKSPACE}: set {_WORKSPACE}={_SIZES[0]} in the "
                "environment before the program starts"
            )
        os.environ[_WORKSPACE] = _SIZES[0]
    if wanted and not torch.are_deterministic_algorithms_enabled():
        torch.use_deterministic_algorithms(True)
        # Filling uninitialised memory only costs time here: nothing reads it before writing.
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
        _here = True
    elif not wanted and _here:
        torch.use_deterministic_algorithms(False)
        torch.utils.deterministic.fill_uninitialized_memory = True  # type: ignore[attr-defined]
        _here = False
