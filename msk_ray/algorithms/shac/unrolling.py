"""How many iterations of the constraint solver are unrolled in a recorded env step, which cannot stop early.

Axes: S substeps of an env step.
"""

import numpy as np
from numpy.typing import NDArray

from msk_ray.step.forward.iterations import limits_for, reached

FEWEST = 6
"""Least number in a substep: early epochs may hardly touch the ground."""
MOST = 48
"""Beyond this many in a substep, unrolled iterations cost more than recording saves."""
_RARE_SHARE = 1e-3
"""Share of a substep's worlds that may reach the first number."""
_LIMITED_SHARE = 3e-3
"""Later: share of them above which more iterations are unrolled."""


def unrolled_iterations(
    counts: NDArray[np.int64], before: tuple[int, ...] | None, limit: int, *, followed: bool
) -> tuple[int, ...]:
    """Iterations to unroll in each of the S substeps, at most the solver's limit.

    Args:
        counts: worlds of the last epoch by substep and by iterations that they took, (S, N); zeros if unknown.
        before: iterations unrolled before; None if there were none.
        limit: the solver's.
        followed: whether the last epoch kept to those of before, so that no world shows how many more it needs.
    """
    limits = before or (FEWEST,) * len(counts)
    if followed:
        shares = reached(counts, limits)
        wanted = [n + (n + 3) // 4 if share > _LIMITED_SHARE else n for n, share in zip(limits, shares, strict=True)]
    else:
        wanted = [max(pair) for pair in zip(limits, limits_for(counts, _RARE_SHARE), strict=True)]
    return tuple(min(n, limit) for n in wanted)
