"""Where points come from under a deformation: solved for all steps at once, flagged where that fails."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.errors import NotConvergedError
from musclefit.fields.evaluation import bsplines
from musclefit.flow.deformation import Deformation
from musclefit.flow.steps import ExplicitStep
from musclefit.geometry.arrays import Bool, Float, Points

FULL_ITERATIONS = 40
"""Newton iterations with the Jacobian of all steps, halved where they do not help."""

CHORD_ITERATIONS = 3
"""Corrections with the guess's own slope before the full Jacobian is asked for."""


@dataclass(frozen=True, eq=False, slots=True)
class Origins:
    """Where points come from: (N, 3) positions, mm, and (N,) whether the map takes them back within the tolerance."""

    points: Points
    found: Bool


@dataclass(frozen=True, eq=False, slots=True)
class Guess:
    """A spline of origins minus targets, mm, on a lattice of targets.

    Parameters
    ----------
    coefficients : (n0, n1, n2, 3) float64, mm
        Of cubic B-splines at whole lattice coordinates.
    linear : (3, 3) float64
    shift : (3,) float64
        Lattice coordinates of a target are ``linear @ target + shift``.
    """

    coefficients: Float
    linear: Float
    shift: Float

    def at(self, targets: Points) -> tuple[Points, Float]:
        """Guessed origins (N, 3) and the slopes (N, 3, 3) of origins by targets."""
        values, slopes = targets.copy(), np.zeros((len(targets), 3, 3))
        places = np.einsum("pk,ik->pi", targets, self.linear) + self.shift
        bsplines.spline_sum_with_gradient(np.zeros(3), np.ones(3), self.coefficients, places, values, slopes)
        return values, np.eye(3) + np.einsum("pik,kj->pij", slopes, self.linear)


def origins(deformation: Deformation, targets: Points, *, tolerance_mm: float) -> Origins:
    """Where (N, 3) points come from, without a guess.

    Cayley steps are inverted one after the other by the same steps reversed. Explicit steps are solved together by
    damped Newton iterations. A point that is found is taken back to its target within ``tolerance_mm``.
    """
    if not any(isinstance(step, ExplicitStep) for step in deformation.steps):
        try:
            return Origins(deformation.inverse()(targets), np.ones(len(targets), dtype=bool))
        except NotConvergedError:
            return _full(deformation, targets, np.array(targets), tolerance_mm)
    return _full(deformation, targets, np.array(targets), tolerance_mm)


def origins_near(deformation: Deformation, targets: Points, *, guess: Guess, tolerance_mm: float) -> Origins:
    """Where (N, 3) points come from, from a guess that is close: a few evaluations of the map's values alone."""
    found, slopes = guess.at(targets)
    left = np.arange(len(targets))
    aims = targets
    for _ in range(CHORD_ITERATIONS):
        try:
            residual = deformation(found[left]) - aims
        except NotConvergedError:
            break
        unmet = np.flatnonzero(~(_largest(residual) <= tolerance_mm))
        if not unmet.size:
            return Origins(found, np.ones(len(targets), dtype=bool))
        if unmet.size < 0.9 * len(left):
            left, aims, slopes, residual = left[unmet], aims[unmet], slopes[unmet], residual[unmet]
        found[left] -= np.einsum("pik,pk->pi", slopes, residual)
    whole = np.ones(len(targets), dtype=bool)
    solved = _full(deformation, targets[left], found[left], tolerance_mm)
    found[left], whole[left] = solved.points, solved.found
    return Origins(found, whole)


def _largest(vectors: Points) -> Float:
    """(N,) largest absolute component of (N, 3) vectors; faster than a reduction over a short axis."""
    sizes = np.abs(vectors)
    return np.asarray(np.maximum(np.maximum(sizes[:, 0], sizes[:, 1]), sizes[:, 2]), dtype=np.float64)


def _full(deformation: Deformation, targets: Points, start: Points, tolerance_mm: float) -> Origins:
    points, found = start.copy(), np.zeros(len(targets), dtype=bool)
    left = np.arange(len(targets))
    best = np.full(len(targets), np.inf)
    steps = np.zeros_like(points)
    for _ in range(FULL_ITERATIONS):
        try:
            moved, jacobians = deformation.with_jacobian(points[left])
        except NotConvergedError:
            return Origins(points, found)
        residual = moved - targets[left]
        size = _largest(residual)
        done = size <= tolerance_mm
        found[left[done]] = True
        worse = ~(size < best[left]) & ~done
        halve = left[worse]
        steps[halve] *= 0.5
        points[halve] -= steps[halve]
        go = ~worse & ~done
        here = left[go]
        best[here] = size[go]
        singular = ~(np.abs(np.linalg.det(jacobians[go])) > 1e-12)
        matrices = jacobians[go]
        matrices[singular] = np.eye(points.shape[1])
        update = -np.linalg.solve(matrices, residual[go][..., None])[..., 0]
        steps[here] = update
        points[here] += update
        left = left[~done]
        if not left.size:
            break
    return Origins(points, found)
