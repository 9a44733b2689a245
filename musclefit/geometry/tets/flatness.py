"""Where a tetrahedron is flattest, and the place of an edge at which a cut frees it; knows no mesh."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from musclefit.geometry.arrays import Float

FLAT = 0.05
"""A tet whose nearest parts are closer than this share of its longest edge is flat, no unit."""

_INNER = 0.1
"""Nearest places count when they are this share away from the ends of their edges."""

Cut = tuple[int, int, float]
"""Two corners of a tet, and the share of the way from the first to the second at which to cut their edge."""


def freeing_cut(corners: Float) -> Cut | None:
    """The cut that takes a flat tet's nearest parts apart, or None where it is not flat, or flat by short edges alone.

    A tet is nearly flat because two opposite edges pass each other closely, because a corner is close to an edge or
    because it is close to the face across. Cut where they are closest (for a corner over a face: on the way there), and
    again so in what is left, the pieces have one short edge across the thin way, and a nearly linear map keeps them
    right-handed however thin that is: its error is then in proportion to that edge, not to the long ones.

    Parameters
    ----------
    corners : (4, 3) float64, mm
    """
    longest = max(float(np.linalg.norm(corners[i] - corners[j])) for i, j in combinations(range(4), 2))
    found = [*_edges_past_each_other(corners), *_corners_at_edges(corners), *_corners_over_faces(corners)]
    distance, cut = min(found, key=lambda item: item[0], default=(np.inf, (0, 0, 0.0)))
    return cut if distance < FLAT * longest else None


def _edges_past_each_other(corners: Float) -> list[tuple[float, Cut]]:
    found = []
    for a, b, c, d in ((0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2)):
        u, v, w = corners[b] - corners[a], corners[d] - corners[c], corners[a] - corners[c]
        uu, uv, vv, uw, vw = u @ u, u @ v, v @ v, u @ w, v @ w
        denominator = uu * vv - uv * uv
        if not denominator > 1e-12 * uu * vv:
            continue
        s, t = (uv * vw - vv * uw) / denominator, (uu * vw - uv * uw) / denominator
        if _is_inner(s) and _is_inner(t):
            distance = float(np.linalg.norm(w + s * u - t * v))
            found.append((distance, (a, b, float(s)) if uu >= vv else (c, d, float(t))))
    return found


def _corners_at_edges(corners: Float) -> list[tuple[float, Cut]]:
    found = []
    for apex in range(4):
        for a, b in combinations([k for k in range(4) if k != apex], 2):
            u, w = corners[b] - corners[a], corners[apex] - corners[a]
            share = float(u @ w / (u @ u)) if u @ u > 0.0 else 0.0
            if _is_inner(share):
                found.append((float(np.linalg.norm(w - share * u)), (a, b, share)))
    return found


def _corners_over_faces(corners: Float) -> list[tuple[float, Cut]]:
    found = []
    for apex in range(4):
        face = [k for k in range(4) if k != apex]
        origin = corners[face[0]]
        edges = (corners[face[1:]] - origin).T
        solution, *_ = np.linalg.lstsq(edges, corners[apex] - origin, rcond=None)
        weights = [1.0 - float(solution.sum()), *map(float, solution)]
        if not all(_is_inner(weight) for weight in weights):
            continue
        height = float(np.linalg.norm(corners[apex] - origin - edges @ solution))
        cuts = [(i, j, weights[j] / (weights[i] + weights[j])) for i, j in combinations(range(3), 2)]
        i, j, share = min(cuts, key=lambda cut: abs(cut[2] - 0.5))
        found.append((height, (face[i], face[j], share)))
    return found


def _is_inner(share: float) -> bool:
    return _INNER < share < 1.0 - _INNER
