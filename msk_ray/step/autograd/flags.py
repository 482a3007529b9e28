"""Flags of worlds, which a host can look at without waiting only where they are in its own memory."""

from torch import Tensor


def known_none(flags: Tensor) -> bool:
    """Whether no flag is set, on a CPU; on a GPU, where to know it the host would wait, False.

    Where it is true, operations on chosen worlds can be left out, with their derivatives: they would copy everything.
    """
    return flags.device.type == "cpu" and not flags.any()
