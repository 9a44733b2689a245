"""Shapes of finite elements: how near a solid is to turning inside out, how far a quadrilateral is from flat."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType

import numpy as np

from musclefit.geometry.arrays import Float, Int, Points


class CellKind(StrEnum):
    """Shapes of elements, with corners in the order that Abaqus and FEBio share."""

    TET = "tetrahedron"
    HEX = "hexahedron"
    WEDGE = "wedge"
    PYRAMID = "pyramid"
    QUAD = "quadrilateral"
    TRIANGLE = "triangle"


CORNERS: Mapping[CellKind, int] = MappingProxyType(
    {
        CellKind.TET: 4,
        CellKind.HEX: 8,
        CellKind.WEDGE: 6,
        CellKind.PYRAMID: 5,
        CellKind.QUAD: 4,
        CellKind.TRIANGLE: 3,
    }
)

SOLIDS = (CellKind.TET, CellKind.HEX, CellKind.WEDGE, CellKind.PYRAMID)

_TRIADS: Mapping[CellKind, tuple[tuple[int, int, int, int], ...]] = MappingProxyType(
    {
        CellKind.TET: ((0, 1, 2, 3), (1, 2, 0, 3), (2, 0, 1, 3), (3, 1, 0, 2)),
        CellKind.HEX: (
            (0, 1, 3, 4),
            (1, 2, 0, 5),
            (2, 3, 1, 6),
            (3, 0, 2, 7),
            (4, 7, 5, 0),
            (5, 4, 6, 1),
            (6, 5, 7, 2),
            (7, 6, 4, 3),
        ),
        CellKind.WEDGE: ((0, 1, 2, 3), (1, 2, 0, 4), (2, 0, 1, 5), (3, 5, 4, 0), (4, 3, 5, 1), (5, 4, 3, 2)),
        CellKind.PYRAMID: ((0, 1, 3, 4), (1, 2, 0, 4), (2, 3, 1, 4), (3, 0, 2, 4)),
    }
)
"""Each corner with the three others that its edges lead to, right-handed where the element is not turned inside out."""

_IDEAL: Mapping[CellKind, float] = MappingProxyType(
    {CellKind.TET: np.sqrt(2.0), CellKind.HEX: 1.0, CellKind.WEDGE: 2.0 / np.sqrt(3.0), CellKind.PYRAMID: np.sqrt(2.0)}
)
"""What makes the triads of the ideal element 1."""


def scaled_jacobians(vertices: Points, corners: Int, *, kind: CellKind) -> Float:
    r"""(k,) smallest scaled Jacobian of each solid: 1 for the ideal element, 0 or less where a corner is turned over.

    .. math:: J = c \min_i \det [e_1, e_2, e_3] / (|e_1| |e_2| |e_3|)

    over the corners i with the edges e that leave them; c makes it 1 for the regular element (at a pyramid's base).
    An edge without length gives 0.

    Parameters
    ----------
    vertices : (n, 3) float64
    corners : (k, c) int64
    kind : CellKind
        One of ``SOLIDS``.
    """
    smallest = np.full(len(corners), np.inf)
    for corner, *others in _TRIADS[kind]:
        edges = [vertices[corners[:, other]] - vertices[corners[:, corner]] for other in others]
        lengths = np.prod([np.linalg.norm(edge, axis=1) for edge in edges], axis=0)
        determinant = np.einsum("ki,ki->k", edges[0], np.cross(edges[1], edges[2]))
        with np.errstate(divide="ignore", invalid="ignore"):
            smallest = np.minimum(smallest, np.where(lengths > 0.0, determinant / lengths, 0.0))
    return np.asarray(np.minimum(_IDEAL[kind] * smallest, 1.0), dtype=np.float64)


def warpages(vertices: Points, corners: Int) -> Float:
    """(k,) warpage of each quadrilateral, degrees.

    The larger angle between the two triangles that either diagonal cuts it into; 0 where it is flat.

    Parameters
    ----------
    vertices : (n, 3) float64
    corners : (k, 4) int64
    """
    a, b, c, d = (vertices[corners[:, k]] for k in range(4))
    return np.maximum(_between(a, b, c, d), _between(b, c, d, a))


def _between(a: Points, b: Points, c: Points, d: Points) -> Float:
    """Angles between the triangles a b c and a c d, degrees."""
    one, other = np.cross(b - a, c - a), np.cross(c - a, d - a)
    sine = np.linalg.norm(np.cross(one, other), axis=1)
    return np.asarray(np.degrees(np.arctan2(sine, np.einsum("ki,ki->k", one, other))), dtype=np.float64)
