"""Recognise out-of-memory errors of torch, Warp and NumPy."""

import torch

# Warp and torch's CPU allocator raise plain RuntimeErrors, recognisable only by their text.
_WORDING = ("failed to allocate", "can't allocate memory", "cudaerrormemoryallocation", "error 2: out of memory")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception says that memory could not be allocated."""
    if isinstance(error, (torch.OutOfMemoryError, MemoryError)):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error).lower() for words in _WORDING)
