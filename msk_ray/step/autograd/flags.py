"""Flags of worlds, which the host can read without waiting only on a CPU."""

from torch import Tensor


def known_none(flags: Tensor) -> bool:
    """Whether no flag is set. On a GPU always False, because the host would have to wait.

    If True, operations on flagged worlds, which would copy all worlds, can be skipped, with their derivatives.
    """
    return flags.device.type == "cpu" and not flags.any()
