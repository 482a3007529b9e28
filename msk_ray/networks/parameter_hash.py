"""A hash of all weights and statistics of a trial: runs with equal hashes have learned the same bits."""

from collections.abc import Mapping
from hashlib import blake2b

import torch
from torch import Tensor


def parameter_hash(modules: Mapping[str, Mapping[str, object]]) -> str:
    """Digest of named tensors: 32 hexadecimal digits.

    It depends on names, types, shapes and bits, not on the modules' order or device.

    Args:
        modules: state of each module by name, as `torch.nn.Module.state_dict` gives it. Values that are not tensors,
            such as numbers, are hashed as text.
    """
    digest = blake2b(digest_size=16)
    for module in sorted(modules):
        for name in sorted(modules[module]):
            value = modules[module][name]
            digest.update(f"{module}.{name}\0".encode())
            digest.update(_bytes_of(value) if isinstance(value, Tensor) else f"{value!r}\0".encode())
    return digest.hexdigest()


def tensor_hash(value: Tensor) -> str:
    """Digest of one tensor's type, shape and bits: 32 hexadecimal digits."""
    return blake2b(_bytes_of(value), digest_size=16).hexdigest()


def as_number(digest: str) -> float:
    """The first 12 digits of a digest as a number that a metrics row holds exactly."""
    return float(int(digest[:12], 16))


def _bytes_of(value: Tensor) -> bytes:
    data = value.detach().cpu().contiguous()
    head = f"{data.dtype} {tuple(data.shape)}\0".encode()
    return head + data.reshape(-1).view(torch.uint8).numpy().tobytes() if data.numel() else head
