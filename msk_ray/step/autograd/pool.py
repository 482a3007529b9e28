"""One buffer for many small Warp arrays, so that one operation copies a recorded step in or out."""

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

_ALIGN = 64  # words; keeps every array on a 256-byte boundary


class Pool:
    """Collects requests for arrays, then creates them all in one allocation."""

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._claims: list[tuple[Callable[[wp.array], None], tuple[int, ...], Any]] = []

    def floats(self, holder: dict[str, wp.array], name: str, *shape: int) -> None:
        """Request a float32 array, which `allocate` stores in holder[name]."""
        self._claims.append((lambda array: holder.__setitem__(name, array), shape, wp.float32))

    def adopt(self, holder: Any, name: str) -> None:
        """Request that `allocate` moves the array `holder.name` into the buffer."""
        old = getattr(holder, name)
        assert old.is_contiguous, name
        assert wp.types.type_size_in_bytes(old.dtype) % 4 == 0, name

        def place(array: wp.array) -> None:
            wp.copy(array, old)
            setattr(holder, name, array)

        self._claims.append((place, old.shape, old.dtype))

    def allocate(self) -> Tensor:
        """Create all arrays; returns the buffer as one float32 tensor, which must outlive them."""
        offsets, total = [], 0
        for _, shape, dtype in self._claims:
            offsets.append(total)
            words = wp.types.type_size_in_bytes(dtype) // 4
            for extent in shape:
                words *= extent
            total += -(-words // _ALIGN) * _ALIGN
        buffer = torch.zeros(max(total, 1), dtype=torch.float32, device=torch.device(str(self._device)))
        for (place, shape, dtype), offset in zip(self._claims, offsets, strict=True):
            pointer = buffer.data_ptr() + 4 * offset
            place(wp.array(ptr=pointer, dtype=dtype, shape=shape, device=self._device, copy=False))
        return buffer
