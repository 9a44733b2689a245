r"""Fields whose gradient jumps at single places, as those of the kernel r do at its centres.

Near such a place the gradient is that of all other terms plus w v^T, with w fixed and v the direction from the place, a
unit vector. Means of gradients over segments have a v of at most unit length. With A = I + s G, G the gradient of the
other terms, det(A + s w v^T) = det(A) (1 + s v . A^-1 w) (Sylvester): no such matrix is singular where
a = |s A^-1 w| < 1, and its smallest singular value is at least (1 - a) times A's, since
|(I + s A^-1 w v^T) x| >= (1 - a) |x|. Where a > 1, orientation is reversed beside the place, along -s A^-1 w.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from musclefit.fields.protocol import Field
from musclefit.geometry.arrays import Bool, Float, Gradients, Points

ILL = 1e-6
"""Matrices whose smallest singular value is less than this share of the largest are left alone."""

ROUNDING = 1e-9
"""Of what is computed with the others."""

BESIDE = (1e-2, 1e-3, 1e-5)
"""How far from a place of a jump a fold is looked for, in sizes of the body."""


@runtime_checkable
class Jumping(Protocol):
    """A field that bounds its gradient apart from one jump."""

    @property
    def jumps(self) -> Points:
        """(J, n) places at which the gradient jumps, mm."""
        ...

    def jump_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float, Points]:
        """Enclosures over boxes of the gradient without its nearest jump, (B, n, n) and (B,), and (B, n) w of that."""
        ...


def least_singular_at_jumps(field: Field, s: float, centres: Points, halves: Float) -> tuple[Float, Float]:
    """(B,) smallest singular values of I + s grad D over boxes without what their radii allow, and those (B,).

    NaN where nothing is known. The smallest singular value of every mean of I + s grad D over a box, and over segments
    in it, is at least the first less the second, and its determinant's sign is positive where that is positive.
    """
    least, off = np.full(len(centres), np.nan), np.full(len(centres), np.inf)
    if not isinstance(field, Jumping) or not len(field.jumps) or not len(centres):
        return least, off
    gradients, radii, jumps = field.jump_bounds(centres, halves)
    matrices = np.eye(centres.shape[1]) + s * gradients
    known: Bool = np.isfinite(matrices).all(axis=(1, 2)) & np.isfinite(radii)
    values = np.linalg.svd(matrices[known], compute_uv=False)
    good = (values[:, -1] > ILL * values[:, 0]) & (np.linalg.det(matrices[known]) > 0.0)
    rows = np.flatnonzero(known)[good]
    moved = np.linalg.solve(matrices[rows], s * jumps[rows, :, None])[..., 0]
    share = 1.0 - np.linalg.norm(moved, axis=1) * (1.0 + ROUNDING)
    least[rows] = values[good, -1] * share - ROUNDING * values[good, 0]
    off[rows] = abs(s) * radii[rows] * (1.0 + ROUNDING)
    return least, off


def beside_jumps(field: Field, factors: tuple[float, ...], size: float) -> Points:
    """(K, n) places beside jumps at which a step may reverse orientation, for a body of a size, mm."""
    if not isinstance(field, Jumping) or not len(field.jumps):
        return np.zeros((0, 0))
    at = field.jumps
    gradients, _, jumps = field.jump_bounds(at, np.zeros_like(at))
    places = []
    for s in factors:
        matrices = np.eye(at.shape[1]) + s * gradients
        known = np.flatnonzero(np.isfinite(matrices).all(axis=(1, 2)))
        known = known[np.abs(np.linalg.det(matrices[known])) > ILL]
        moved = np.linalg.solve(matrices[known], s * jumps[known, :, None])[..., 0]
        length = np.linalg.norm(moved, axis=1)
        folds = length > 1.0
        ways = -moved[folds] / length[folds, None]
        places += [at[known][folds] + share * size * ways for share in BESIDE]
    return np.concatenate(places)
