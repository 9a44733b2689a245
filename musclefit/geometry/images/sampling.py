"""Reads images between their voxels, threaded: takes voxel values and places in voxel numbers; knows no frame.

A place belongs to the image up to half a voxel beyond its outermost voxel centres, as in ITK; there the edge is
continued. Elsewhere the value is the one given for outside.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import spline_filter1d

from musclefit.compiling import njit, threaded
from musclefit.geometry.arrays import Points
from musclefit.geometry.images.grids import Interpolation


def prefiltered(values: NDArray[Any], interpolation: Interpolation) -> NDArray[Any]:
    """What `sample` reads: the values, or for cubic interpolation their B-spline coefficients, as float32."""
    if interpolation is not Interpolation.CUBIC:
        return values
    coefficients = values.astype(np.float32)
    for axis in range(3):
        if coefficients.shape[axis] > 1:
            spline_filter1d(coefficients, order=3, axis=axis, output=coefficients, mode="mirror")
    return coefficients


def sample(
    values: NDArray[Any], indices: Points, *, interpolation: Interpolation, outside: float, out: NDArray[Any]
) -> None:
    """Write the values at (N, 3) places to ``out`` (N,).

    Parameters
    ----------
    values : (nx, ny, nz) array
        As `prefiltered` gives them.
    indices : (N, 3) float64
        In voxel numbers.
    interpolation : Interpolation
    outside : float
        Value beyond the image.
    out : (N,) array
    """
    loops = {Interpolation.LINEAR: _linear, Interpolation.CUBIC: _cubic, Interpolation.NEAREST: _nearest}
    loops[interpolation](values, indices, outside, out)


@njit(inline="always")
def _is_in(indices, p, shape):
    for axis in range(3):  # noqa: SIM110 (compiled)
        if not (-0.5 <= indices[p, axis] < shape[axis] - 0.5):
            return False
    return True


@threaded(over="indices", least=2000)
def _nearest(begin, end, values, indices, outside, out):
    for p in range(begin, end):
        if _is_in(indices, p, values.shape):
            i, j, k = indices[p]
            out[p] = values[int(np.floor(i + 0.5)), int(np.floor(j + 0.5)), int(np.floor(k + 0.5))]
        else:
            out[p] = outside


@njit(inline="always")
def _pair(x, count):
    """The two voxels around a coordinate, kept inside, and the share of the second."""
    base = int(np.floor(x))
    return max(base, 0), min(base + 1, count - 1), x - base


@threaded(over="indices", least=2000)
def _linear(begin, end, values, indices, outside, out):
    for p in range(begin, end):
        if not _is_in(indices, p, values.shape):
            out[p] = outside
            continue
        i0, i1, u = _pair(indices[p, 0], values.shape[0])
        j0, j1, v = _pair(indices[p, 1], values.shape[1])
        k0, k1, w = _pair(indices[p, 2], values.shape[2])
        low = (1.0 - v) * ((1.0 - w) * values[i0, j0, k0] + w * values[i0, j0, k1])
        low += v * ((1.0 - w) * values[i0, j1, k0] + w * values[i0, j1, k1])
        high = (1.0 - v) * ((1.0 - w) * values[i1, j0, k0] + w * values[i1, j0, k1])
        high += v * ((1.0 - w) * values[i1, j1, k0] + w * values[i1, j1, k1])
        out[p] = (1.0 - u) * low + u * high


@njit(inline="always")
def _cubic_axis(x, count, where, weights):
    base = int(np.floor(x))
    t = x - base
    s = 1.0 - t
    weights[0], weights[3] = s * s * s / 6.0, t * t * t / 6.0
    weights[1] = (4.0 + t * t * (3.0 * t - 6.0)) / 6.0
    weights[2] = (4.0 + s * s * (3.0 * s - 6.0)) / 6.0
    for a in range(4):
        q = base - 1 + a
        if count == 1:
            q = 0
        elif q < 0:
            q = -q
        elif q >= count:
            q = 2 * count - 2 - q
        where[a] = min(max(q, 0), count - 1)


@threaded(over="indices", each=256, least=8)
def _cubic(begin, end, values, indices, outside, out):
    block = 256
    for start in range(begin, end):
        i, j, k = np.empty(4, np.int64), np.empty(4, np.int64), np.empty(4, np.int64)
        u, v, w = np.empty(4), np.empty(4), np.empty(4)
        for p in range(start * block, min(len(indices), (start + 1) * block)):
            if not _is_in(indices, p, values.shape):
                out[p] = outside
                continue
            _cubic_axis(indices[p, 0], values.shape[0], i, u)
            _cubic_axis(indices[p, 1], values.shape[1], j, v)
            _cubic_axis(indices[p, 2], values.shape[2], k, w)
            total = 0.0
            for a in range(4):
                for b in range(4):
                    row = 0.0
                    for c in range(4):
                        row += w[c] * values[i[a], j[b], k[c]]
                    total += u[a] * v[b] * row
            out[p] = total
