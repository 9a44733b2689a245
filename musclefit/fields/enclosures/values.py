"""Radial sums at points with a proved bound of their own rounding; see `radial_sums` for how it is reckoned."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from musclefit.compiling import njit, threaded
from musclefit.fields.enclosures.source_terms import SMALL, rounding_share
from musclefit.fields.evaluation.neighbours import runs_around


@njit(error_model="numpy")
def _everywhere(slope, r):  # noqa: ARG001 (what every kernel is given)
    return slope


@cache
def value_sums(values: Any, steepest: Any, *, isochoric: bool) -> Callable[..., None]:
    """A kernel's sums with their rounding; see `musclefit.fields.kernels.model.Enclosure`."""
    value_terms, slope_bound = values, steepest or _everywhere

    @threaded(over="points", least=16, error_model="numpy")
    def summed(
        begin, end, scale, slope, sources, weights, sizes, low, width, counts, starts, points, blur, out, errors
    ):
        """Write the sum at points (N, 3) local to the origin to ``out``, and its rounding error to ``errors`` (N,).

        ``slope``: the constant of the kernel's sup |grad D| per unit of weight (see `Enclosure.steepest`). Sources,
        in the order of their cells (`Cells`), are 0 beyond the cells around a point.
        """
        m = sizes.size
        runs = np.empty((9, 2), np.int64)
        for i in range(begin, end):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            if not np.isfinite(x + y + z):  # nowhere: nothing is known
                out[i, 0], out[i, 1], out[i, 2], errors[i] = np.nan, np.nan, np.nan, np.nan
                continue
            u, v, w, parts, steep = 0.0, 0.0, 0.0, 0.0, 0.0
            for run in range(runs_around(x, y, z, low, width, counts, starts, runs)):
                for j in range(runs[run, 0], runs[run, 1]):
                    dx, dy, dz = x - sources[0, j], y - sources[1, j], z - sources[2, j]
                    r = np.sqrt(dx * dx + dy * dy + dz * dz)
                    a, b, c = weights[0, j], weights[1, j], weights[2, j]
                    f, g, size = value_terms(scale, r)
                    if isochoric:
                        s = g * (dx * a + dy * b + dz * c)
                        u += f * a + s * dx
                        v += f * b + s * dy
                        w += f * c + s * dz
                    else:
                        u += f * a
                        v += f * b
                        w += f * c
                    parts += sizes[j] * size
                    steep += sizes[j] * slope_bound(slope, r + 2.0 * blur)
            out[i, 0], out[i, 1], out[i, 2] = u, v, w
            errors[i] = (4.0 * rounding_share(m) * parts + blur * steep) * (1.0 + rounding_share(m)) + SMALL

    made: Callable[..., None] = summed
    return made
