"""How far vertices may go along straight lines before a tet turns inside out: proved, not by floating-point roots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from musclefit.compiling import njit
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Bool, Float, Points, Tets
from musclefit.geometry.tets.orientation import integers, triple_products

DEPTH = 40
"""Halvings of the motion: the answer is within 2^-40 of the largest fraction that Bernstein's criterion proves."""

Quadruple: TypeAlias = tuple[int, ...]
"""Four Bernstein coefficients of a cubic."""

_BOUND = 2.0**-48
"""Rounding of a Bernstein coefficient over the sum of its terms' sizes: 32 roundings at most, each of 2^-53."""
_TINY = 1e-200
_CHUNK = 1 << 16


@dataclass(frozen=True, slots=True)
class SafeFraction:
    """How far a straight motion is proved to keep every tet right-handed.

    Parameters
    ----------
    fraction : float in [0, 1]
        All tets have positive volume at every time in [0, fraction]; 0 where one has not at the start.
    tet : int
        The tet that ends it, -1 when none does.
    """

    fraction: float
    tet: int


def largest_safe_fraction(start: Points, end: Points, tets: Tets) -> SafeFraction:
    r"""The largest proved part of the motion :math:`x(t) = (1-t)\,x_0 + t\,x_1` in which no tet is flat or inverted.

    The volume of a tet is a cubic of t. In Bernstein form on an interval it is positive throughout when its four
    coefficients are; where they are not, the interval is halved. Coefficients that are positive beyond their rounding
    error are taken in floating point, all others in integers, so that nothing is rounded where it matters.

    Parameters
    ----------
    start, end : (n, 3) float64, mm
    tets : (k, 4) int64

    Raises
    ------
    MeshError
        Positions of different shapes, or not finite.
    """
    if start.shape != end.shape:
        raise MeshError(f"the motion starts at positions of shape {start.shape} and ends at {end.shape}")
    if not (np.isfinite(start).all() and np.isfinite(end).all()):
        raise MeshError("the motion has positions that are not finite")
    best, blocking = 1 << DEPTH, -1
    unsure = np.flatnonzero(~positive_throughout(start, end, tets))
    for begin in range(0, len(unsure), _CHUNK):
        part = unsure[begin : begin + _CHUNK]
        for tet, row in zip(part, bernstein_coefficients(start[tets[part]], end[tets[part]]), strict=True):
            reached = _proved_until(tuple(row), 0, DEPTH, best)
            if reached < best:
                best, blocking = reached, int(tet)
    return SafeFraction(best / (1 << DEPTH), blocking)


def bernstein_coefficients(start: Float, end: Float) -> np.ndarray:
    """Of the volumes of tets, corners (k, 4, 3) before and after: (k, 4) exact integers, times one positive number."""
    whole = integers(np.stack([start, end]))
    edges = whole[:, :, 1:] - whole[:, :, :1]
    sums = np.zeros((len(start), 4), dtype=object)
    for mask in range(8):
        pick = [(mask >> k) & 1 for k in range(3)]
        sums[:, sum(pick)] += triple_products(np.stack([edges[pick[k], :, k] for k in range(3)], axis=1))
    scaled: np.ndarray = sums * np.array([3, 1, 1, 3], dtype=object)
    return scaled


def _proved_until(b: Quadruple, low: int, depth: int, limit: int) -> int:
    """The end of the longest part from ``low`` on, in units of 2^-DEPTH, that is proved positive; at most ``limit``."""
    high = low + (1 << depth)
    if low >= limit or b[0] <= 0:
        return min(low, limit)
    if min(b) > 0:
        return min(high, limit)
    if depth == 0:
        return low
    left, right = _halves(b)
    reached = _proved_until(left, low, depth - 1, limit)
    middle = low + (1 << (depth - 1))
    return reached if reached < middle else _proved_until(right, middle, depth - 1, limit)


def _halves(b: Quadruple) -> tuple[Quadruple, Quadruple]:
    """Bernstein coefficients of both halves, times 8."""
    p, q, r = b[0] + b[1], b[1] + b[2], b[2] + b[3]
    pq, qr = p + q, q + r
    return (8 * b[0], 4 * p, 2 * pq, pq + qr), (pq + qr, 2 * qr, 4 * r, 8 * b[3])


def positive_throughout(start: Points, end: Points, tets: Tets) -> Bool:
    """(k,) True for tets that floating point alone proves right-handed all the way."""
    proved = np.zeros(len(tets), dtype=np.bool_)
    _positive_throughout(np.ascontiguousarray(start), np.ascontiguousarray(end), np.ascontiguousarray(tets), proved)
    return proved


@njit(cache=True)
def _positive_throughout(start, end, tets, proved):
    edges = np.empty((2, 3, 3))
    sums = np.empty(4)
    sizes = np.empty(4)
    for t in range(len(tets)):
        for k in range(3):
            for axis in range(3):
                edges[0, k, axis] = start[tets[t, k + 1], axis] - start[tets[t, 0], axis]
                edges[1, k, axis] = end[tets[t, k + 1], axis] - end[tets[t, 0], axis]
        sums[:] = 0.0
        sizes[:] = 0.0
        for mask in range(8):
            i = mask & 1
            j = (mask >> 1) & 1
            k = (mask >> 2) & 1
            a = edges[i, 0]
            b = edges[j, 1]
            c = edges[k, 2]
            sums[i + j + k] += (
                a[0] * (b[1] * c[2] - b[2] * c[1])
                + a[1] * (b[2] * c[0] - b[0] * c[2])
                + a[2] * (b[0] * c[1] - b[1] * c[0])
            )
            sizes[i + j + k] += (
                abs(a[0]) * (abs(b[1] * c[2]) + abs(b[2] * c[1]))
                + abs(a[1]) * (abs(b[2] * c[0]) + abs(b[0] * c[2]))
                + abs(a[2]) * (abs(b[0] * c[1]) + abs(b[1] * c[0]))
            )
        fine = True
        for k in range(4):
            if not (_TINY < sizes[k] < np.inf and sums[k] > _BOUND * sizes[k]):
                fine = False
        proved[t] = fine
