"""Quantiles of weighted values."""

from __future__ import annotations

import numpy as np

from musclefit.geometry.arrays import Float


def weighted_quantile(values: Float, weights: Float, share: float) -> float:
    """The least of (n,) values below or at which a share of all (n,) weights lies."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(below, share * below[-1])), len(values) - 1)]])
