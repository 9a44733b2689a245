"""Single steps made from a displacement field: where they take points, their Jacobian, their inverse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from musclefit.errors import NotConvergedError
from musclefit.fields.protocol import Field
from musclefit.geometry.arrays import Gradients, Points

NEWTON_TOLERANCE_MM = 1e-11
"""An implicit step is solved when its equation holds to this at coordinates up to a metre (in proportion beyond)."""
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

    def jacobian_from(self, gradients: Gradients) -> Gradients:
        """The step's Jacobian at points whose trial gave these gradients."""
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

    def jacobian_from(self, gradients: Gradients) -> Gradients:
        """I + grad D."""
        return np.eye(gradients.shape[-1]) + gradients

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
        return self.trial(points).moved

    def jacobian(self, points: Points) -> Gradients:
        """The inverse of I + grad D at the points found."""
        return self.jacobian_from(self.trial(points).gradients)

    def trial(self, points: Points) -> Trial:
        """Moved points, and the gradients there."""
        return Trial(*_newton(self.of.field, points, factor=1.0))

    def jacobian_from(self, gradients: Gradients) -> Gradients:
        """The inverse of I + grad D."""
        return np.asarray(np.linalg.inv(self.of.jacobian_from(gradients)), dtype=np.float64)

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
        return self.trial(points).moved

    def jacobian(self, points: Points) -> Gradients:
        """(I + G/2)(I - G/2)^-1 with G the gradient at the midpoints."""
        return self.jacobian_from(self.trial(points).gradients)

    def trial(self, points: Points) -> Trial:
        """Moved points, and the gradients at the midpoints."""
        middle, gradients = _newton(self.field, points, factor=-0.5)
        return Trial(2.0 * middle - points, gradients)

    def jacobian_from(self, gradients: Gradients) -> Gradients:
        """(I + G/2)(I - G/2)^-1."""
        half = 0.5 * gradients
        eye = np.eye(gradients.shape[-1])
        # (I + H)(I - H)^-1 = (I - H)^-1 (I + H): they commute
        return np.asarray(np.linalg.solve(eye - half, eye + half), dtype=np.float64)

    def inverse(self) -> CayleyStep:
        """The same step with the field reversed."""
        return CayleyStep(self.field.scaled(-1.0))


def _newton(field: Field, targets: Points, *, factor: float) -> tuple[Points, Gradients]:
    """Solve y + factor D(y) = target for each point; gives the points and the gradients there.

    Updates that do not lower the residual are halved.
    """
    n = targets.shape[1]
    solution, gradients = np.array(targets), np.empty((len(targets), n, n))
    unsolved = np.arange(len(targets))
    damping, last = np.ones(len(targets)), np.full(len(targets), np.inf)
    tolerance = NEWTON_TOLERANCE_MM * max(1.0, float(np.abs(targets).max(initial=0.0)) / 1000.0)
    for _ in range(NEWTON_MAX_ITERATIONS):
        here = solution[unsolved]
        displacement, slope = field.displacement_and_gradient(here)
        residual = here + factor * displacement - targets[unsolved]
        size = np.abs(residual).max(axis=1)
        gradients[unsolved] = slope
        still = size > tolerance
        if not still.any():
            return solution, gradients
        unsolved, here, slope, residual, size = (a[still] for a in (unsolved, here, slope, residual, size))
        damping[unsolved] = np.where(size < last[unsolved], 1.0, 0.5 * damping[unsolved])
        last[unsolved] = size
        update = np.linalg.solve(np.eye(n) + factor * slope, residual[..., None])[..., 0]
        solution[unsolved] = here - damping[unsolved, None] * update
    worst = int(unsolved[np.argmax(last[unsolved])])
    raise NotConvergedError(
        f"an implicit step has no solution at {unsolved.size} of {len(targets)} points, first at "
        f"{np.round(targets[worst], 3).tolist()} mm (residual {last[worst]:.3g} mm); the field is too steep "
        "there for one step: use smaller steps",
        result=solution,
    )
