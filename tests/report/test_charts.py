"""Charts of the report."""

import numpy as np

from msk_ray.report.charts import POINTS, thin_peaks


def test_thinning_keeps_every_peak() -> None:
    y = np.zeros(10 * POINTS)
    peaks = np.random.default_rng(1).choice(len(y), 20, replace=False)
    y[peaks] = 1.0 + np.arange(20)
    y[np.setdiff1d(np.arange(0, len(y), 7), peaks)] = np.nan
    x, thinned = thin_peaks(np.arange(len(y), dtype=float), y)
    assert len(x) <= POINTS
    assert thinned.max() == 20.0
    assert np.all(y[x.astype(int)] == thinned), "each at its own place"
    blocks = np.unique(peaks // 10)
    assert (thinned > 0).sum() == len(blocks)
