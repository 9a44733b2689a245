"""Does the map fold at the tested points? Jacobian determinants there -> check; a sampled claim, never a proof."""

from __future__ import annotations

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points
from musclefit.validate.model import MapCheck
from musclefit.vocabulary import Claim


def check_map(
    determinants: Float, *, points: Points, rule: str, margin: float, gap_mm: float | None = None
) -> MapCheck:
    """Count the tested points where the map's Jacobian determinant is not positive.

    Parameters
    ----------
    determinants : (N,) float64
        Of the whole map's Jacobian at the points.
    points : (N, 3) float64, mm
        At rest.
    rule : str
        What ``margin`` was judged by, in words.
    margin : float
        Smallest over all steps and tested points: 1 at rest, 0 at the rule's limit, negative beyond.
    gap_mm : float or None
        No place of the surfaces is farther from one of the points; None where they are no samples of surfaces.

    Returns
    -------
    MapCheck
        ``REFUTED`` where a tested point folds (det <= 0 or not a number), otherwise ``SAMPLED``.

    Raises
    ------
    InputError
        There is no point to test, or not one determinant for each.
    """
    if not len(points):
        raise InputError("there is no point to test the map at; give at least one")
    if determinants.shape != (len(points),):
        raise InputError(f"{len(points)} points have determinants of shape {determinants.shape}; give one for each")
    folded = int(np.sum(~(determinants > 0.0)))
    worst = int(np.argmin(np.nan_to_num(determinants, nan=-np.inf)))
    x, y, z = (float(c) for c in points[worst])
    return MapCheck(
        claim=Claim.REFUTED if folded else Claim.SAMPLED,
        rule=rule,
        margin=margin,
        points_tested=len(points),
        folded_points=folded,
        min_jacobian_determinant=float(determinants[worst]),
        place_mm=(x, y, z),
        gap_mm=gap_mm,
    )
