"""What was computed, stage by stage, as digests: two runs that are the same give the same list."""

from collections.abc import Mapping
from typing import NamedTuple

from torch import Tensor

from msk_ray.networks import tensor_hash


class Noted(NamedTuple):
    """One tensor of a run."""

    epoch: int
    """Counted from 1; 0 is the start."""
    stage: str
    tensor: str
    digest: str


class Witness:
    """Keeps digests of the tensors of a run, in the order in which they are computed.

    Attributes:
        epoch: the epoch that is being trained, counted from 1; 0 before the first.
        noted: what was seen.
    """

    def __init__(self) -> None:
        self.epoch = 0
        self.noted: list[Noted] = []

    def note(self, stage: str, tensors: Mapping[str, Tensor]) -> None:
        """Keep digests of tensors of a stage; waits for the device."""
        self.noted += [Noted(self.epoch, stage, name, tensor_hash(value)) for name, value in tensors.items()]
