"""Digests of what was computed, stage by stage: identical runs give identical lists."""

from collections.abc import Mapping
from typing import NamedTuple

from torch import Tensor

from msk_ray.networks import tensor_hash


class StageDigest(NamedTuple):
    """The digest of one tensor of a run."""

    epoch: int
    """Counted from 1; 0 is the start."""
    stage: str
    tensor: str
    digest: str


class DigestLog:
    """Keeps digests of the tensors of a run, in the order in which they are computed.

    Attributes:
        epoch: the epoch that is being trained, counted from 1; 0 before the first.
        digests: digests recorded so far.
    """

    def __init__(self) -> None:
        self.epoch = 0
        self.digests: list[StageDigest] = []

    def note(self, stage: str, tensors: Mapping[str, Tensor]) -> None:
        """Record digests of a stage's tensors; waits for the device."""
        self.digests += [StageDigest(self.epoch, stage, name, tensor_hash(value)) for name, value in tensors.items()]
