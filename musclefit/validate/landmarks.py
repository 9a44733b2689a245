"""How far landmarks ended from their destinations: names and positions -> check."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from musclefit.errors import LandmarkError
from musclefit.geometry.arrays import Points
from musclefit.validate.model import LandmarkCheck


def check_landmarks(names: Sequence[str], *, arrived: Points, targets: Points) -> LandmarkCheck:
    """The largest distance of a landmark from its destination.

    Parameters
    ----------
    names : sequence of m str
    arrived, targets : (m, n) float64, mm

    Raises
    ------
    LandmarkError
        There is no landmark, or names, arrivals and destinations are not of one count; a position is not finite.
    """
    if not len(names):
        raise LandmarkError("there is no landmark to check; give at least one")
    if not len(names) == len(arrived) == len(targets) or arrived.shape != targets.shape:
        raise LandmarkError(
            f"{len(names)} landmark names, arrivals of shape {arrived.shape} and destinations of shape "
            f"{targets.shape} do not belong together; give one row per name in both"
        )
    errors = np.linalg.norm(arrived - targets, axis=1)
    bad = np.flatnonzero(~np.isfinite(errors))
    if bad.size:
        raise LandmarkError(
            f"landmark {names[bad[0]]!r} arrived at {arrived[bad[0]]} for {targets[bad[0]]}, which is not finite; "
            "the deformation that moved it is unusable"
        )
    worst = int(errors.argmax())
    return LandmarkCheck(count=len(names), max_error_mm=float(errors[worst]), worst=names[worst])
