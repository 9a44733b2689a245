"""Does the map fold at the tested points? Jacobians there -> check; a sampled claim, never a proof."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Gradients, Points
from musclefit.validate.model import MapCheck, MapClaim


def check_map(jacobian: Callable[[Points], Gradients], points: Points, *, rule: str, margin: float) -> MapCheck:
    """Count the tested points where the map's Jacobian determinant is not positive.

    Parameters
    ----------
    jacobian : callable
        (N, 3) mm at rest -> (N, 3, 3) derivatives of the whole map.
    points : (N, 3) float64, mm
        At rest.
    rule : str
        What ``margin`` was judged by, in words.
    margin : float
        Smallest over all steps and tested points: 1 at rest, 0 at the rule's limit, negative beyond.

    Returns
    -------
    MapCheck
        ``REFUTED`` where a tested point folds (det <= 0 or not a number), otherwise ``SAMPLED``.

    Raises
    ------
    InputError
        There is no point to test.
    """
    if not len(points):
        raise InputError("there is no point to test the map at; give at least one")
    determinants = np.linalg.det(jacobian(points))
    folded = int(np.sum(~(determinants > 0.0)))
    worst = int(np.argmin(np.nan_to_num(determinants, nan=-np.inf)))
    x, y, z = (float(c) for c in points[worst])
    return MapCheck(
        claim=MapClaim.REFUTED if folded else MapClaim.SAMPLED,
        rule=rule,
        margin=margin,
        points_tested=len(points),
        folded_points=folded,
        min_jacobian_determinant=float(determinants[worst]),
        place_mm=(x, y, z),
    )
