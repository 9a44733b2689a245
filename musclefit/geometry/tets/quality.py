"""Shapes of tetrahedra: angles between faces."""

from __future__ import annotations

import numpy as np

from musclefit.geometry.arrays import Float, Points, Tets

_AROUND = ((0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 1, 2), (1, 2, 0, 3), (1, 3, 2, 0), (2, 3, 0, 1))
"""For each edge its corners, and the two others."""


def dihedral_angles(vertices: Points, tets: Tets) -> Float:
    r"""(k, 6) angles between the two faces at each edge of each tet, degrees.

    Of a regular tet all are 70.5; near 0 and 180 the tet is a sliver, which a small bend turns inside out. An edge
    without length, or a face without area, has no angle: NaN.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    tets : (k, 4) int64
    """
    corners = vertices[tets]
    angles = np.empty((len(tets), 6))
    for edge, (a, b, c, d) in enumerate(_AROUND):
        along = corners[:, b] - corners[:, a]
        one = np.cross(along, corners[:, c] - corners[:, a])
        other = np.cross(along, corners[:, d] - corners[:, a])
        sine = np.linalg.norm(np.cross(one, other), axis=1)
        cosine = np.einsum("ki,ki->k", one, other)
        angles[:, edge] = np.where((sine == 0.0) & (cosine == 0.0), np.nan, np.degrees(np.arctan2(sine, cosine)))
    return angles
