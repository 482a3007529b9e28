"""The picture of gradient quality: cosine and norm ratio over the horizon."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from msk_ray.diagnose.probe import Quality


def draw(rows: Sequence[Quality], path: Path) -> Path:
    """Write a PNG: one column per kind of state, one line per physics; median over worlds with their range."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    states = list(dict.fromkeys(row.state for row in rows))
    variants = list(dict.fromkeys(row.variant for row in rows))
    figure, axes = pyplot.subplots(
        2, len(states), figsize=(1.5 + 3.2 * len(states), 5.4), sharex=True, sharey="row", squeeze=False
    )
    for column, state in enumerate(states):
        for variant in variants:
            own = [row for row in rows if row.state == state and row.variant == variant]
            horizons = sorted({row.horizon for row in own})
            for line, field in enumerate(("cosine", "norm_ratio")):
                values = [np.array([getattr(row, field) for row in own if row.horizon == h]) for h in horizons]
                (drawn,) = axes[line, column].plot(horizons, [np.median(v) for v in values], "o-", label=variant)
                axes[line, column].fill_between(
                    horizons, [v.min() for v in values], [v.max() for v in values], alpha=0.15, color=drawn.get_color()
                )
        axes[0, column].set_title(f"from {state}")
        axes[1, column].set_xlabel("horizon [env steps]")
        axes[1, column].set_yscale("log")
        axes[1, column].set_xscale("log", base=2)
        axes[1, column].axhline(1.0, color="grey", linewidth=0.5)
    axes[0, 0].set_ylabel("cosine with float64 differences")
    axes[1, 0].set_ylabel("norm ratio")
    axes[0, 0].legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
    return path
