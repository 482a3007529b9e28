"""What commands print before and while Warp compiles kernels."""

from msk_ray.progress import COMPILING, KernelCount, announce


def announce_compiling(text: str) -> None:
    """Print what a command is about to do, and from then on how many kernels are ready, if compiling them takes long.

    Loads Warp, once the text is printed.
    """
    announce(f"{text}; {COMPILING}")
    count_kernels()


def count_kernels() -> None:
    """Print how many kernels are ready, from now on, if compiling them takes long."""
    from msk_ray.step.forward import on_compiling

    on_compiling(KernelCount())
