"""Compiled parts of implicit steps: Newton updates and Cayley Jacobians at many points at once; knows no field.

Points are in space or in a plane, which is taken for a space whose third direction nothing moves in.
"""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit, threaded


@njit(inline="always")
def _inverse(factor, slope, out):
    """Write the inverse (3, 3) of I + factor slope, by cofactors, and give the determinant; nothing where that is 0."""
    n = slope.shape[0]
    a, b = 1.0 + factor * slope[0, 0], factor * slope[0, 1]
    d, e = factor * slope[1, 0], 1.0 + factor * slope[1, 1]
    c, f, g, h, i = 0.0, 0.0, 0.0, 0.0, 1.0
    if n == 3:
        c, f = factor * slope[0, 2], factor * slope[1, 2]
        g, h, i = factor * slope[2, 0], factor * slope[2, 1], 1.0 + factor * slope[2, 2]
    out[0, 0], out[0, 1], out[0, 2] = e * i - f * h, c * h - b * i, b * f - c * e
    out[1, 0], out[1, 1], out[1, 2] = f * g - d * i, a * i - c * g, c * d - a * f
    out[2, 0], out[2, 1], out[2, 2] = d * h - e * g, b * g - a * h, a * e - b * d
    determinant = a * out[0, 0] + d * out[0, 1] + g * out[0, 2]
    if determinant != 0.0:
        for j in range(3):
            for k in range(3):
                out[j, k] /= determinant
    return determinant


@threaded(over="left", least=512, error_model="numpy")
def advance(
    begin, end, factor, tolerance, rounding, trusted_mm, share, left, displacement, slopes, targets,
    tried, kept, update, damping, last, gradients, done,
):  # fmt: skip
    """One iteration of `steps._descended` at the points ``left`` (L,), whose field is ``displacement`` and ``slopes``.

    ``last`` is the lowest residual, mm, of the place ``kept``; the tolerance where its last update is trusted. Where
    the matrix is singular, the update is the residual itself.
    """
    n = targets.shape[1]
    inverse, residual = np.zeros((3, 3)), np.zeros(3)
    for q in range(begin, end):
        p, size, known = left[q], 0.0, True
        for k in range(n):
            residual[k] = tried[p, k] + factor * displacement[q, k] - targets[p, k]
            size = max(size, abs(residual[k]))
            known = known and residual[k] == residual[k]
        before = last[p]
        if known and size < before:
            last[p], damping[p], done[q] = size, 1.0, size <= tolerance
            regular = not done[q] and _inverse(factor, slopes[q], inverse) != 0.0
            for k in range(n):
                kept[p, k], update[p, k] = tried[p, k], residual[k]
                for i in range(n):
                    gradients[p, k, i] = slopes[q, k, i]
                if regular:
                    update[p, k] = 0.0
                    for i in range(n):
                        update[p, k] += inverse[k, i] * residual[i]
            sure = before < np.inf and size * size * size <= share * tolerance * before * before
            if regular and size <= trusted_mm and sure:
                last[p], done[q] = tolerance, True
                for k in range(n):
                    kept[p, k] -= update[p, k]
        else:
            damping[p] *= 0.5
            done[q] = before <= rounding
        if not done[q]:
            for k in range(n):
                tried[p, k] = kept[p, k] - damping[p] * update[p, k]


@threaded(over="gradients", least=512, error_model="numpy")
def cayley_jacobians(begin, end, gradients, out):
    """Write (I + G/2)(I - G/2)^-1 = 2 (I - G/2)^-1 - I for gradients G (N, n, n); NaN where there is none."""
    n = gradients.shape[1]
    inverse = np.zeros((3, 3))
    for p in range(begin, end):
        regular = _inverse(-0.5, gradients[p], inverse) != 0.0
        for k in range(n):
            for i in range(n):
                out[p, k, i] = 2.0 * inverse[k, i] if regular else np.nan
            out[p, k, k] -= 1.0
