"""How close two solids come: exact between their triangles, up to a stated distance."""

from __future__ import annotations

import numpy as np

from musclefit.geometry.queries.solids import Solid


def smallest_gap(a: Solid, b: Solid, *, within_mm: float) -> float:
    """Smallest distance between two solids, mm; 0 where they overlap, infinity where it is ``within_mm`` or more.

    Parameters
    ----------
    a, b : Solid
    within_mm : float
        Distances beyond are not told apart, which is quicker.
    """
    if (a.box[0] - within_mm > b.box[1]).any() or (b.box[0] - within_mm > a.box[1]).any():
        return np.inf
    gap = float(a.manifold.min_gap(b.manifold, within_mm))
    return gap if gap < within_mm else np.inf
