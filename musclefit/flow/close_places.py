"""Many places taken through a map at once: takes a map and places that lie close to each other; knows no tissue.

An implicit step solves an equation for each place, by Newton's method. Of places that share a cell of a lattice one is
solved first; the others begin at what its midpoint and its derivatives tell of theirs, a few hundredths of a millimetre
off, in place of half a step. What is solved is the same equation to the same tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from musclefit.flow.deformation import Deformation
from musclefit.flow.steps import CayleyStep, Trial
from musclefit.geometry.arrays import Gradients, Int, Points

TOGETHER = 16
"""Places of a cell in the mean, at least."""

WIDER = 1.3
"""Times as wide cells are tried next, where too few places share one."""

FEW = 256
"""So few places are taken one by one."""


@dataclass(frozen=True, eq=False, slots=True)
class Companions:
    """Places that share cells.

    Parameters
    ----------
    first : (c,) int64
        The place of each cell that is solved first.
    others : (N - c,) int64
        All other places, cell by cell.
    leader : (N - c,) int64
        The cell of each of these.
    """

    first: Int
    others: Int
    leader: Int

    @classmethod
    def of(cls, points: Points) -> Self:
        """Of (N, n) places, mm, in cells as wide as it takes for ``TOGETHER`` of them."""
        low, span = points.min(axis=0), np.ptp(points, axis=0)
        width = float(span.max()) / max(1.0, (len(points) / TOGETHER) ** (1.0 / points.shape[1]))
        width = max(width / WIDER**6, float(np.abs(points).max()) * 1e-9, 1e-9)
        while True:
            cells = np.floor((points - low) / width).astype(np.int64)
            sides = cells.max(axis=0) + 1
            _, first, cell = np.unique(
                np.ravel_multi_index(tuple(cells.T), tuple(sides)), return_index=True, return_inverse=True
            )
            if len(first) * TOGETHER <= len(points) or len(first) == 1:
                break
            width *= WIDER
        led = np.ones(len(points), dtype=bool)
        led[first] = False
        order = np.argsort(cell.ravel(), kind="stable")
        others = order[led[order]]
        return cls(first.astype(np.int64), others, cell.ravel()[others].astype(np.int64))

    def middles(self, points: Points, trial: Trial) -> Points:
        """Where the midpoints of the others may lie, mm, once those of the first are known by their trial."""
        at = points[self.first]
        n = at.shape[1]
        slopes = np.asarray(np.linalg.inv(np.eye(n) - 0.5 * trial.gradients), dtype=np.float64)
        apart = points[self.others] - at[self.leader]
        found: Points = 0.5 * (at + trial.moved)[self.leader] + np.einsum("nij,nj->ni", slopes[self.leader], apart)
        return found


def moved_together(deformation: Deformation, points: Points) -> Points:
    """Where a map takes (N, n) points, mm: as the map itself says, but for what its equations' tolerance leaves open.

    Raises
    ------
    NotConvergedError
        An implicit step has no solution at a point.
    """
    if len(points) <= FEW:
        return deformation(points)
    companions = Companions.of(points)
    moved = np.array(points, dtype=np.float64)
    for step in deformation.steps:
        if isinstance(step, CayleyStep):
            trial = step.trial(moved[companions.first])
            others = step.moved_from(moved[companions.others], companions.middles(moved, trial))
            moved[companions.first], moved[companions.others] = trial.moved, others
        else:
            moved = step(moved)
    return moved


def with_jacobian_together(deformation: Deformation, points: Points) -> tuple[Points, Gradients]:
    """Moved points and derivatives, as `Deformation.with_jacobian` and `moved_together`.

    Raises
    ------
    NotConvergedError
        An implicit step has no solution at a point.
    """
    if len(points) <= FEW or deformation.ridden.holds(points):
        return deformation.with_jacobian(points)
    companions = Companions.of(points)
    moved = np.array(points, dtype=np.float64)
    whole: Gradients = np.broadcast_to(np.eye(points.shape[1]), (len(points), *(points.shape[1],) * 2)).copy()
    for step in deformation.steps:
        if isinstance(step, CayleyStep):
            first = step.trial(moved[companions.first])
            others = step.trial_from(moved[companions.others], companions.middles(moved, first))
            gradients = np.empty_like(whole)
            for where, trial in ((companions.first, first), (companions.others, others)):
                moved[where], gradients[where] = trial.moved, trial.gradients
        else:
            trial = step.trial(moved)
            moved, gradients = trial.moved, trial.gradients
        whole = step.jacobian_from(gradients) @ whole
    return moved, whole
