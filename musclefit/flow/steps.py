"""Single steps made from a displacement field: where they take points, their Jacobian, their inverse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from musclefit.errors import NotConvergedError
from musclefit.fields.protocol import Field
from musclefit.geometry.arrays import Gradients, Points

NEWTON_TOLERANCE_MM = 1e-11
"""An implicit step is solved when its equation holds to this, relative to coordinates of up to a metre."""
NEWTON_MAX_ITERATIONS = 30


@dataclass(frozen=True, eq=False, slots=True)
class Trial:
    """Where a step takes tested points, and the field's gradients where its rule must hold."""

    moved: Points
    gradients: Gradients


class Step(Protocol):
    """A map of space made from one displacement field."""

    @property
    def field(self) -> Field:
        """The field it is made from."""
        ...

    def __call__(self, points: Points) -> Points:
        """Move (N, n) points, mm."""
        ...

    def jacobian(self, points: Points) -> Gradients:
        """(N, n, n) derivatives of the moved points."""
        ...

    def trial(self, points: Points) -> Trial:
        """Moved points and the gradients that its rule judges, in one pass."""
        ...

    def inverse(self) -> Step:
        """The step that undoes this one."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class ExplicitStep:
    """x -> x + D(x): the step of Yu et al. 2014."""

    field: Field

    def __call__(self, points: Points) -> Points:
        """Move (N, n) points, mm."""
        return points + self.field.displacement(points)

    def jacobian(self, points: Points) -> Gradients:
        """I + grad D."""
        return np.eye(points.shape[1]) + self.field.gradient(points)

    def trial(self, points: Points) -> Trial:
        """Moved points, and the gradients at the points themselves."""
        displacement, gradients = self.field.displacement_and_gradient(points)
        return Trial(points + displacement, gradients)

    def inverse(self) -> InverseStep:
        """The inverse map, found point by point with Newton's method."""
        return InverseStep(self)


@dataclass(frozen=True, eq=False, slots=True)
class InverseStep:
    """y -> the x with x + D(x) = y, by damped Newton.

    Raises
    ------
    NotConvergedError
        On call, where no such x is found: the step is not one-to-one there, or the point is far outside its domain.
    """

    of: ExplicitStep

    @property
    def field(self) -> Field:
        """The field of the step it undoes."""
        return self.of.field

    def __call__(self, points: Points) -> Points:
        """Move (N, n) points back, mm."""
        return _newton(self.of.field, points, factor=1.0)

    def jacobian(self, points: Points) -> Gradients:
        """The inverse of I + grad D at the points found."""
        return np.asarray(np.linalg.inv(self.of.jacobian(self(points))), dtype=np.float64)

    def trial(self, points: Points) -> Trial:
        """Moved points, and the gradients there."""
        moved = self(points)
        return Trial(moved, self.of.field.gradient(moved))

    def inverse(self) -> ExplicitStep:
        """The step that this one undoes."""
        return self.of


@dataclass(frozen=True, eq=False, slots=True)
class CayleyStep:
    r"""Implicit midpoint step: x1 = x0 + D((x0 + x1) / 2).

    Written as U = (id + D/2) o (id - D/2)^-1, so that a skew gradient (a rotation) costs nothing; the same step with -D
    is its exact inverse; it keeps volume to third order where D has no divergence.

    Raises
    ------
    NotConvergedError
        On call, where the midpoint is not found: the field is too steep for a single step there.
    """

    field: Field

    def __call__(self, points: Points) -> Points:
        """Move (N, n) points, mm."""
        return 2.0 * self._midpoints(points) - points

    def jacobian(self, points: Points) -> Gradients:
        """(I + G/2)(I - G/2)^-1 with G the gradient at the midpoints."""
        return _cayley(self.field.gradient(self._midpoints(points)))

    def trial(self, points: Points) -> Trial:
        """Moved points, and the gradients at the midpoints."""
        middle = self._midpoints(points)
        return Trial(2.0 * middle - points, self.field.gradient(middle))

    def inverse(self) -> CayleyStep:
        """The same step with the field reversed."""
        return CayleyStep(self.field.scaled(-1.0))

    def _midpoints(self, points: Points) -> Points:
        return _newton(self.field, points, factor=-0.5)


def _cayley(gradients: Gradients) -> Gradients:
    half = 0.5 * gradients
    eye = np.eye(gradients.shape[-1])
    # (I + H)(I - H)^-1 = (I - H)^-1 (I + H): they commute
    return np.asarray(np.linalg.solve(eye - half, eye + half), dtype=np.float64)


def _newton(field: Field, targets: Points, *, factor: float) -> Points:
    """Solve y + factor D(y) = target for each point; halves Newton updates that do not lower the residual."""
    n = targets.shape[1]
    solution = targets - factor * field.displacement(targets)
    open_points = np.arange(len(targets))
    damping = np.ones(len(targets))
    last = np.full(len(targets), np.inf)
    tolerance = NEWTON_TOLERANCE_MM * max(1.0, float(np.abs(targets).max(initial=0.0)) / 1000.0)
    for _ in range(NEWTON_MAX_ITERATIONS):
        displacement, gradients = field.displacement_and_gradient(solution[open_points])
        residual = solution[open_points] + factor * displacement - targets[open_points]
        size = np.abs(residual).max(axis=1)
        damping[open_points] = np.where(size > last[open_points], 0.5 * damping[open_points], 1.0)
        last[open_points] = size
        update = np.linalg.solve(np.eye(n) + factor * gradients, residual[..., None])[..., 0]
        solution[open_points] -= damping[open_points, None] * update
        # The update just made squares the residual: what was below the root of the tolerance is now below it.
        done = size**2 <= tolerance * 1e-3
        open_points = open_points[~done]
        if not open_points.size:
            return solution
    worst = int(open_points[np.argmax(last[open_points])])
    raise NotConvergedError(
        f"an implicit step has no solution at {open_points.size} of {len(targets)} points, first at "
        f"{np.round(targets[worst], 3).tolist()} mm (residual {last[worst]:.3g} mm); the field is too steep "
        "there for one step: use smaller steps",
        result=solution,
    )
