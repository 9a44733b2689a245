"""How many marked cells a block of a grid has, for very many blocks: from the sums of all cells before each."""

from __future__ import annotations

import numpy as np

from musclefit.geometry.arrays import Bool, Int


def counts_before(marked: Bool) -> Int:
    """How many marked cells of a grid stand before each cell along all axes; one longer along each than the grid."""
    sums = np.pad(marked.astype(np.int64), ((1, 0),) * marked.ndim)
    for axis in range(sums.ndim):
        sums = sums.cumsum(axis=axis)
    return sums


def counts_between(before: Int, first: Int, last: Int) -> Int:
    """(N,) marked cells from the first to the last, (N, n) numbers along each axis, both included."""
    n = first.shape[1]
    total = np.zeros(len(first), dtype=np.int64)
    for ends in np.ndindex(*(2,) * n):
        corner = np.where(np.array(ends) == 1, last + 1, first)
        total += (-1) ** (n - sum(ends)) * before[tuple(corner.T)]
    return total
