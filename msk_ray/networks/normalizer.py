"""Running mean and variance."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

_EPSILON = 1e-5


class RunningMeanStd(nn.Module):
    """Mean and variance of all rows seen, merged batch by batch (Chan, Golub and LeVeque 1979)."""

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(shape))
        self.register_buffer("var", torch.ones(shape))
        # A small prior count makes the first batch's statistics replace the initial ones.
        self.register_buffer("count", torch.tensor(1e-4, dtype=torch.float64))

    @torch.no_grad()
    def update(self, rows: Tensor) -> None:
        """Update the statistics with rows (N, *shape)."""
        n = rows.shape[0]
        mean, var = rows.mean(0), rows.var(0, unbiased=False)
        delta = mean - self.mean
        total = self.count + n
        share = (n / total).to(mean.dtype)
        # M₂ of the union = M₂ₐ + M₂ᵦ + δ² nₐ nᵦ / (nₐ + nᵦ), divided by nₐ + nᵦ.
        self.var.copy_((1.0 - share) * self.var + share * var + delta**2 * share * (1.0 - share))
        self.mean.add_(delta * share)
        self.count.copy_(total)

    def normalize(self, x: Tensor) -> Tensor:
        """(x − mean) / std."""
        return self.fixed()(x)

    def fixed(self) -> Callable[[Tensor], Tensor]:
        """`normalize` with the current statistics fixed, for many calls before the next `update`."""
        scale = torch.rsqrt(self.var + _EPSILON)
        return lambda x: (x - self.mean) * scale
