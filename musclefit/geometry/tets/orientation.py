"""The sign of a tetrahedron's volume, exactly: a fast test in floating point, integers where it cannot tell."""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Bool, Float, Int, Points, Tets

_HALF_ULP = 2.0**-53
_BOUND = (7.0 + 56.0 * _HALF_ULP) * _HALF_ULP * (1.0 + 2.0**-40)
"""Shewchuk's bound of the rounding error over the permanent, a hair wider for the bound's own rounding."""
_TINY = 1e-200
"""Permanents below this may have lost products to underflow; they are left to integers."""
_CHUNK = 1 << 18


def orientations(vertices: Points, tets: Tets) -> Int:
    r"""Exact sign of the volume of each tetrahedron.

    .. math:: \operatorname{sign} \det [v_1 - v_0,\; v_2 - v_0,\; v_3 - v_0]

    A floating-point determinant decides where it is farther from 0 than its rounding error can be; the others are
    evaluated in integers of any length, so that the answer is that of real arithmetic for all finite positions,
    denormal ones included.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    tets : (k, 4) int64

    Returns
    -------
    (k,) int64
        1 right-handed, -1 left-handed, 0 exactly flat.

    Raises
    ------
    MeshError
        A position that is not finite has no orientation.

    References
    ----------
    J. R. Shewchuk, "Adaptive precision floating-point arithmetic and fast robust geometric predicates", 1997: the
    first stage and its error bound.
    """
    _require_finite(vertices)
    vertices, tets = np.ascontiguousarray(vertices), np.ascontiguousarray(tets)
    signs = _filtered(vertices, tets)
    unsure = np.flatnonzero(signs == _UNSURE)
    for start in range(0, len(unsure), _CHUNK):
        part = unsure[start : start + _CHUNK]
        signs[part] = signs_of(triple_products(integer_edges(vertices[tets[part]])))
    return signs


def undecided_in_floating_point(vertices: Points, tets: Tets) -> Bool:
    """(k,) True where `orientations` needs integers; MeshError as there."""
    _require_finite(vertices)
    signs = _filtered(np.ascontiguousarray(vertices), np.ascontiguousarray(tets))
    unsure: Bool = signs == _UNSURE
    return unsure


def integer_edges(corners: Float) -> np.ndarray:
    """Edges from the first corner to the others, as exact integers times one common power of two for all.

    Parameters
    ----------
    corners : (k, 4, 3) float64

    Returns
    -------
    (k, 3, 3) object
        Python integers; entry [t, i] is corner i + 1 less corner 0.
    """
    whole = integers(corners)
    edges: np.ndarray = whole[:, 1:] - whole[:, :1]
    return edges


def integers(values: Float) -> np.ndarray:
    """Floating-point numbers as exact integers (object), times one common power of two."""
    mantissas, exponents = np.frexp(values)
    whole = (mantissas * 2.0**53).astype(np.int64).astype(object)
    used = exponents[values != 0.0]
    lowest = int(used.min()) if used.size else 0
    shifts = np.where(values != 0.0, exponents - lowest, 0).astype(object)
    shifted: np.ndarray = whole << shifts
    return shifted


def triple_products(edges: np.ndarray) -> np.ndarray:
    """(k,) determinants of (k, 3, 3) matrices of exact integers."""
    a, b, c = (tuple(edges[:, i, axis] for axis in range(3)) for i in range(3))
    products: np.ndarray = (
        a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    return products


def signs_of(values: np.ndarray) -> Int:
    """(k,) int64 signs of exact integers."""
    signs: Int = (values > 0).astype(np.int64) - (values < 0).astype(np.int64)
    return signs


def _require_finite(vertices: Points) -> None:
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if bad.size:
        raise MeshError(f"{bad.size} vertices are not finite, the first is number {bad[0]}: {vertices[bad[0]]}")


_UNSURE = 2


def _filtered(vertices: Points, tets: Tets) -> Int:
    """(k,) signs of volumes, or _UNSURE; arrays that can be written are compiled for as those that cannot."""
    vertices, tets = vertices.view(), tets.view()
    vertices.flags.writeable = tets.flags.writeable = False
    signs = np.empty(len(tets), dtype=np.int64)
    _filter(vertices, tets, signs)
    return signs


@njit(cache=True)
def _filter(vertices, tets, signs):
    for t in range(len(tets)):
        o = tets[t, 0]
        p = tets[t, 1]
        q = tets[t, 2]
        r = tets[t, 3]
        ax = vertices[p, 0] - vertices[o, 0]
        ay = vertices[p, 1] - vertices[o, 1]
        az = vertices[p, 2] - vertices[o, 2]
        bx = vertices[q, 0] - vertices[o, 0]
        by = vertices[q, 1] - vertices[o, 1]
        bz = vertices[q, 2] - vertices[o, 2]
        cx = vertices[r, 0] - vertices[o, 0]
        cy = vertices[r, 1] - vertices[o, 1]
        cz = vertices[r, 2] - vertices[o, 2]
        det = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        size = (
            abs(ax) * (abs(by * cz) + abs(bz * cy))
            + abs(ay) * (abs(bz * cx) + abs(bx * cz))
            + abs(az) * (abs(bx * cy) + abs(by * cx))
        )
        bound = _BOUND * size
        if not (_TINY < size < np.inf):
            signs[t] = _UNSURE
        elif det > bound:
            signs[t] = 1
        elif -det > bound:
            signs[t] = -1
        else:
            signs[t] = _UNSURE
