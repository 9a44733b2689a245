"""Finite elements before and after a deformation: turned inside out, scaled Jacobian, warpage; knows no deck."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Int, Points
from musclefit.geometry.elements import SOLIDS, CellKind, scaled_jacobians, warpages


@dataclass(frozen=True, slots=True)
class ElementCheck:
    """The elements of one shape before and after.

    Parameters
    ----------
    kind : CellKind
    count : int
    inverted_before, inverted_after : int
        Solids with a corner whose Jacobian is 0 or less.
    introduced : int
        Those inverted after and not before.
    jacobian_before, jacobian_after : float or None
        Smallest scaled Jacobian: 1 for the ideal element. None for shells.
    warpage_before_deg, warpage_after_deg : float or None
        Largest warpage. None for all but quadrilaterals.
    worst : str
        The element with the smallest scaled Jacobian, or the largest warpage, after; "" for triangles.
    """

    kind: CellKind
    count: int
    inverted_before: int = 0
    inverted_after: int = 0
    introduced: int = 0
    jacobian_before: float | None = None
    jacobian_after: float | None = None
    warpage_before_deg: float | None = None
    warpage_after_deg: float | None = None
    worst: str = ""


def check_elements(kind: CellKind, names: Sequence[str], corners: Int, *, rest: Points, moved: Points) -> ElementCheck:
    """Judge the elements of one shape at rest and moved.

    Parameters
    ----------
    kind : CellKind
    names : sequence of k str
    corners : (k, c) int64
    rest, moved : (n, 3) float64
    """
    if kind in SOLIDS:
        before, after = (scaled_jacobians(places, corners, kind=kind) for places in (rest, moved))
        worst = int(np.argmin(after))
        return ElementCheck(
            kind,
            len(names),
            inverted_before=int((before <= 0.0).sum()),
            inverted_after=int((after <= 0.0).sum()),
            introduced=int(((after <= 0.0) & (before > 0.0)).sum()),
            jacobian_before=float(before.min()),
            jacobian_after=float(after.min()),
            worst=names[worst],
        )
    if kind is CellKind.QUAD:
        before, after = warpages(rest, corners), warpages(moved, corners)
        return ElementCheck(
            kind,
            len(names),
            warpage_before_deg=float(before.max()),
            warpage_after_deg=float(after.max()),
            worst=names[int(np.argmax(after))],
        )
    return ElementCheck(kind, len(names))
