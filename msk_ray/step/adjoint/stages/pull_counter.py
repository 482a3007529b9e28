"""How many env steps have been pulled back."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def count_pull(count_out: wp.array[int]) -> None:
    """One more, by a single thread."""
    count_out[0] = count_out[0] + 1


class PullCounter:
    """Counts on the device: a backward pass that is part of a larger recorded graph runs without Python."""

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._count = wp.zeros(1, dtype=int, device=device)

    def launch(self) -> None:
        """Launch the count of one env step."""
        wp.launch(count_pull, dim=1, outputs=[self._count], device=self._device)

    def read(self) -> int:
        """The number since the last read."""
        count = int(self._count.numpy()[0])
        self.clear()
        return count

    def clear(self) -> None:
        """Forget what was counted."""
        self._count.zero_()
