"""Single steps made from a displacement field: where they take points, their Jacobian, their inverse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from musclefit.errors import NotConvergedError
from musclefit.fields.protocol import Field
from musclefit.flow.newton_updates import advance, cayley_jacobians
from musclefit.geometry.arrays import Float, Gradients, Int, Points

NEWTON_TOLERANCE_MM = 1e-11
"""An implicit step is solved when its equation holds to this at coordinates up to a metre (in proportion beyond)."""
NEWTON_ROUNDING_MM = 2e-9
"""What rounding may leave of it where iteration does not help, in the same proportion: sums of r³ over bodies of metres
cancel to 4e-10 mm."""
NEWTON_MAX_ITERATIONS = 30
BRANCH_STEPS = 16
"""Strengths of the field through which a solution is followed where Newton's method alone does not find it."""
BRANCH_TOLERANCE_MM = 1e-3
TRUSTED_MM = 1e-5
"""From a residual no larger than this a last update may go unchecked, where only a place is asked for."""
TRUSTED_SHARE = 0.1
"""And only where, converging as fast as before, it leaves no more than this share of the tolerance."""


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
        """Moved points, and the gradients there.

        Raises
        ------
        NotConvergedError
            No point is found that the step takes there.
        """
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
        """Moved points, and the gradients at the midpoints.

        Raises
        ------
        NotConvergedError
            No midpoint is found.
        """
        return self.trial_from(points, None)

    def trial_from(self, points: Points, middles: Points | None) -> Trial:
        """As ``trial``, from guessed (N, n) midpoints, mm, if there are any.

        Raises
        ------
        NotConvergedError
            No midpoint is found.
        """
        middle, gradients = _newton(self.field, points, factor=-0.5, start=middles)
        return Trial(2.0 * middle - points, gradients)

    def moved_from(self, points: Points, middles: Points) -> Points:
        """Where points go, from guessed (N, n) midpoints, mm; a last update that is sure to do is not checked.

        Raises
        ------
        NotConvergedError
            No midpoint is found.
        """
        moved: Points = 2.0 * _newton(self.field, points, factor=-0.5, start=middles, trusted_mm=TRUSTED_MM)[0] - points
        return moved

    def jacobian_from(self, gradients: Gradients) -> Gradients:
        """(I + G/2)(I - G/2)^-1.

        Raises
        ------
        numpy.linalg.LinAlgError
            I - G/2 is singular at a point.
        """
        found: Gradients = np.empty(gradients.shape)
        cayley_jacobians(np.ascontiguousarray(gradients), found)
        if np.isnan(found).any() and not np.isnan(gradients).any():
            raise np.linalg.LinAlgError("Singular matrix")
        return found

    def inverse(self) -> CayleyStep:
        """The same step with the field reversed."""
        return CayleyStep(self.field.scaled(-1.0))


def jacobian_between(step: Step, before: Points, after: Points) -> Gradients:
    """The step's Jacobian at (N, n) points that it is known to take to ``after``: no equation is solved again, mm."""
    if isinstance(step, CayleyStep):
        return step.jacobian_from(step.field.gradient(0.5 * (before + after)))
    return step.jacobian(before)


def _newton(
    field: Field, targets: Points, *, factor: float, start: Points | None = None, trusted_mm: float = 0.0
) -> tuple[Points, Gradients]:
    """Solve y + factor D(y) = target for each point; gives the points and the gradients there.

    By Newton's method from guesses, if there are any, and from the targets; where that leaves the place in which the
    map is strictly monotone, along the branch of solutions that begins at the target and grows with the field.
    """
    metres = max(1.0, float(np.abs(targets).max(initial=0.0)) / 1000.0)
    goal = _Goal(NEWTON_TOLERANCE_MM * metres, NEWTON_ROUNDING_MM * metres, trusted_mm)
    found = _descended(field, targets, targets if start is None else start, factor=factor, goal=goal)
    left = np.flatnonzero(found.residuals > goal.rounding)
    if left.size and start is not None:
        found.put(left, _descended(field, targets[left], targets[left], factor=factor, goal=goal))
        left = np.flatnonzero(found.residuals > goal.rounding)
    if left.size:
        begin, near = targets[left], _Goal(BRANCH_TOLERANCE_MM, BRANCH_TOLERANCE_MM, 0.0)
        for number in range(1, BRANCH_STEPS):
            part = factor * number / BRANCH_STEPS
            begin = _descended(field, targets[left], begin, factor=part, goal=near).points
        found.put(left, _descended(field, targets[left], begin, factor=factor, goal=goal))
    unsolved = np.flatnonzero(found.residuals > goal.rounding)
    if not unsolved.size:
        return found.points, found.gradients
    worst = int(unsolved[np.argmax(found.residuals[unsolved])])
    raise NotConvergedError(
        f"an implicit step has no solution at {unsolved.size} of {len(targets)} points, first at "
        f"{np.round(targets[worst], 3).tolist()} mm (residual {found.residuals[worst]:.3g} mm); the field is too steep "
        "there for one step: use smaller steps",
        result=found.points,
    )


class _Goal(NamedTuple):
    """Residuals, mm, at which a point is done: at the first anyway, at the second where no update lowers it further.

    At the third it is done with an update more, where that is sure to do.
    """

    tolerance: float
    rounding: float
    trusted_mm: float


class _Found(NamedTuple):
    points: Points
    gradients: Gradients
    residuals: Float

    def put(self, some: Int, better: _Found) -> None:
        """Take over what is found of some of the points."""
        for whole, part in zip(self, better, strict=True):
            whole[some] = part


def _descended(field: Field, targets: Points, start: Points, *, factor: float, goal: _Goal) -> _Found:
    """Newton's method from a start; an update that does not lower the residual is taken back and tried half as long.

    Gives the places with the lowest residuals and the gradients there. From residuals up to ``goal.trusted_mm`` the
    last update is not checked: the method squares residuals, r' = c r², and c is known from the update before. The
    gradients of such a place are those where it was before.
    """
    n = targets.shape[1]
    targets = np.ascontiguousarray(targets, dtype=np.float64)
    tried = np.array(start, dtype=np.float64, order="C")
    kept, update = tried.copy(), np.zeros((len(targets), n))
    gradients = np.full((len(targets), n, n), np.nan)
    left = np.arange(len(targets))
    damping, last = np.ones(len(targets)), np.full(len(targets), np.inf)
    for _ in range(NEWTON_MAX_ITERATIONS):
        if not left.size:
            break
        found, done = field.displacement_and_gradient(tried[left]), np.zeros(len(left), dtype=bool)
        limits = (factor, goal.tolerance, goal.rounding, goal.trusted_mm, TRUSTED_SHARE)
        advance(*limits, left, *found, targets, tried, kept, update, damping, last, gradients, done)
        left = left[~done]
    return _Found(kept, gradients, last)
