"""Fused, threaded sums over all pairs of point and centre, for kernels that need nothing but r and 1/r.

As `radial_sums`; the points are in lanes. Takes points as they are given and
adds the polynomial part.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from musclefit.compiling import njit, threaded
from musclefit.fields.evaluation.lanes import INNER, WIDTH, store

OUTER: dict[str, Any] = {"fastmath": INNER["fastmath"], "error_model": "numpy"}

TINY = 1e-180
"""Added to squared distances (mm²), so that a centre itself gives 0, not NaN."""

BLOCK = 64
"""Points of one task."""


@njit(**INNER)
def store_three(block, row, factor, u, v, w):
    """Three rows of a block, times a factor."""
    store(block, row, factor * u)
    store(block, row + 1, factor * v)
    store(block, row + 2, factor * w)


@njit(inline="always")
def _load_points(points, origin, start, block):
    """Points from ``start`` on, local to the origin; lanes behind the last point repeat it."""
    for lane in range(WIDTH):
        i = min(start + lane, points.shape[0] - 1)
        for k in range(3):
            block[k, lane] = points[i, k] - origin[k]


class LaneSums(NamedTuple):
    """A kernel's compiled sums, points in lanes."""

    values: Callable[..., None]
    gradients: Callable[..., None]


@cache
def lane_sums(of_values: Any, of_gradients: Any) -> LaneSums:
    """From what a kernel does for one block of points.

    Both take ``soft``, the ``sources`` and a (k, WIDTH) ``block`` whose first three rows are the points; they write
    three rows of values and, the second, nine of derivatives behind them.
    """

    @threaded(over="points", each=BLOCK, **OUTER)
    def values_in_lanes(begin, end, soft, points, origin, affine, sources, values):
        """Write t + L x + sum_j K(x - c_j) w_j, x being points minus origin, to values (N, 3).

        Affine is (4, 3): t and the rows of L; sources are (m, 9): centre, local to the origin, weight w and 3 w.
        ``soft`` is the square of a mollifier's length, TINY where there is none.
        """
        n = points.shape[0]
        for task in range(begin, end):
            block = np.empty((6, WIDTH))
            for start in range(task * BLOCK, min(n, (task + 1) * BLOCK), WIDTH):
                _load_points(points, origin, start, block)
                of_values(soft, sources, block)
                for lane in range(min(WIDTH, n - start)):
                    x, y, z = block[0, lane], block[1, lane], block[2, lane]
                    for k in range(3):
                        line = affine[0, k] + affine[k + 1, 0] * x + affine[k + 1, 1] * y + affine[k + 1, 2] * z
                        values[start + lane, k] = line + block[3 + k, lane]

    @threaded(over="points", each=BLOCK, **OUTER)
    def gradients_in_lanes(begin, end, soft, points, origin, affine, sources, values, gradients):
        """As ``values_in_lanes``, with the derivatives (N, 3, 3)."""
        n = points.shape[0]
        for task in range(begin, end):
            block = np.empty((15, WIDTH))
            for start in range(task * BLOCK, min(n, (task + 1) * BLOCK), WIDTH):
                _load_points(points, origin, start, block)
                of_gradients(soft, sources, block)
                for lane in range(min(WIDTH, n - start)):
                    x, y, z = block[0, lane], block[1, lane], block[2, lane]
                    for k in range(3):
                        line = affine[0, k] + affine[k + 1, 0] * x + affine[k + 1, 1] * y + affine[k + 1, 2] * z
                        values[start + lane, k] = line + block[3 + k, lane]
                        for i in range(3):
                            gradients[start + lane, k, i] = affine[k + 1, i] + block[6 + 3 * k + i, lane]

    return LaneSums(values_in_lanes, gradients_in_lanes)
