r"""Covers of a body's surface by balls, and where a step takes them: what encloses the image of the body.

*Invariant*: every point of the surface lies in one of the balls (points, radii); at rest, each piece in one of its own.
Where a step is so steep that a ball proves nothing, its piece is cut in four.

*Explicit step* U = id + D: a ball of radius rho around z goes into a ball around U(z) of radius rho times
sup |I + grad D| over the ball.

*Cayley step* U = (id + D/2) o F^-1 with F = id - D/2. Let y be near the midpoint of z, sigma half the sup of the
largest strain over a ball of radius s around y, and mu = 1 - sigma > 0. F is strictly monotone there,

.. math:: (F(a) - F(b)) \cdot (a - b) \ge \mu |a - b|^2,

so that on the sphere of radius s the homotopy from F - F(y) to id - y never vanishes: the degree of F around F(y) is 1,
and stays 1 for every x with |x - F(y)| <= t < mu s, since |F - F(y)| >= mu s on the sphere. Such an x has a midpoint
within s of y, by monotonicity within t / mu. With rho the radius around z, t = rho + |F(y) - z|. For two midpoints a, b
in the ball and G the mean of grad D between them, U(F(a)) - U(F(b)) = (I + G/2)(I - G/2)^-1 (F(a) - F(b)); for v along
a - b, |v| = 1, c = v . G v / 2 <= sigma and k = |G v| / 2 >= |c|, the squared stretch (1 + k² + 2 c) / (1 + k² - 2 c)
is at most ((1 + c) / (1 - c))² for c >= 0 and at most 1 for c < 0. So x goes within t max(1, (1 + sigma) / (1 - sigma))
of U(F(y)) = y + D(y) / 2. Rotation is free.

*Where it is not monotone*, a midpoint is still found (Newton-Kantorovich): with A about the inverse of I - grad D(y)/2
and k = sup |I - A (I - grad D/2)| < 1 over the ball of radius s, a -> a - A (F(a) - x) contracts by k and keeps the
ball when |A| t <= (1 - k) s. Such an x has a midpoint a within |A| t / (1 - k) of y; a - y = A (x - F(y)) + e,
|e| <= k s, so x goes within |(I + G/2) A| t + (k |I + G/2| + r/2) s of U(F(y)), where grad D is within r of G
over the ball. That it is the only midpoint is for the step's own proof to show. This is tried
everywhere: in small balls it stretches by what the step does, and not by what strain alone would allow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from musclefit.certify.body_shells import UP
from musclefit.certify.strain import (
    LARGEST,
    eigenvalue_rounding,
    gradient_ball_bounds,
    strain_ball_ranges,
    symmetric_eigenvalues,
)
from musclefit.errors import InputError
from musclefit.fields.protocol import Field
from musclefit.geometry.arrays import Bool, Float, Int, Points

ROUNDING = 1e-15
"""Of coordinates of which two or three are added."""

MIDPOINT_REACH = (1.15, 1.6)
"""Radii s around midpoints that are tried, in units of t / (1 - sigma) with sigma sampled at the centre."""

STEEPEST = 0.99
"""Sampled sigma above which strict monotony is not tried."""

NEWTON_CONTRACTION = 0.5
"""k above, at most."""

SINGULAR = 1e-9
"""Determinants up to this are those of no invertible matrix."""

MATRIX_ROUNDING = 1e-13
"""Of the sizes of matrices: what products of two and their norms may be off."""

RESIDUAL_SHARE = 0.02
"""Of a ball's radius: how well its midpoint is solved for; the rest is part of t."""

SOLVED = 1e-6
"""Of the coordinates and of the size of what is covered: midpoints are found when they are solved to this, however
small their balls; by what is left of it the balls grow."""

NEWTON_ITERATIONS = 40


@runtime_checkable
class DisplacementBounded(Protocol):
    """A field whose values are enclosed by proof."""

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Values at the centres of boxes and the radii that hold over each box, (B, n) each."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class Cover:
    """Balls that hold a surface: (N, n) points and (N,) radii, mm."""

    points: Points
    radii: Float


@dataclass(frozen=True, eq=False, slots=True)
class Midpoints:
    """Balls that hold the midpoints of a surface under a Cayley step, and what is proved of the step in them.

    Parameters
    ----------
    points : (N, n) float64, mm
    radii : (N,) float64, mm
        s above.
    reach : (N,) float64, mm
        t above.
    spread : (N,) float64, mm
        How far from the image of the centre the step takes what is covered.
    found : (N,) bool
        Where a ball was found; the others prove nothing.
    hopeless : (N,) bool
        Where smaller balls would not help either: no midpoint is found, or the field is too steep at it.
    """

    points: Points
    radii: Float
    reach: Float
    spread: Float
    found: Bool
    hopeless: Bool

    def without(self, dropped: Bool) -> Midpoints:
        """Those that are not dropped."""
        kept = ~dropped
        return Midpoints(
            self.points[kept],
            self.radii[kept],
            self.reach[kept],
            self.spread[kept],
            self.found[kept],
            self.hopeless[kept],
        )

    def joined(self, other: Midpoints) -> Midpoints:
        """These and then the others."""
        return Midpoints(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.radii, other.radii]),
            np.concatenate([self.reach, other.reach]),
            np.concatenate([self.spread, other.spread]),
            np.concatenate([self.found, other.found]),
            np.concatenate([self.hopeless, other.hopeless]),
        )


def displacement_with_error(field: Field, points: Points) -> tuple[Points, Float]:
    """Values and (N,) proved bounds of how far they are off, in length.

    Raises
    ------
    InputError
        The field does not bound its values.
    """
    if not isinstance(field, DisplacementBounded):
        raise InputError(
            f"a {type(field).__name__} gives no displacement_bounds, so no step made from it can be certified"
        )
    values, radii = field.displacement_bounds(points, np.zeros_like(points))
    return values, np.linalg.norm(radii, axis=1) * UP


def explicit_image(field: Field, cover: Cover) -> Cover:
    """A cover of the image of the surface under x -> x + D(x)."""
    values, errors = displacement_with_error(field, cover.points)
    radii = np.full(len(values), np.inf)
    known = np.isfinite(cover.radii)
    gradients, spread = gradient_ball_bounds(field, cover.points[known], cover.radii[known])
    jacobians = np.eye(cover.points.shape[1]) + gradients
    stretch = np.full(len(jacobians), np.inf)
    whole = np.isfinite(jacobians).all(axis=(1, 2))
    stretch[whole] = np.linalg.norm(jacobians[whole], 2, axis=(1, 2)) + eigenvalue_rounding(jacobians[whole])
    off = errors[known] + _coordinate_rounding(cover.points[known], values[known])
    # A ball of radius 0 under an infinite stretch stays unknown, too.
    radii[known] = ((stretch + spread) * np.maximum(cover.radii[known], 1e-300) + off) * UP
    return Cover(cover.points + values, radii)


def cayley_midpoints(field: Field, cover: Cover) -> Midpoints:
    """Balls that hold the midpoints of the surface under x1 = x0 + D((x0 + x1) / 2)."""
    middle = solve(field, cover.points, factor=-0.5, goals=RESIDUAL_SHARE * cover.radii)
    values, errors = displacement_with_error(field, middle)
    residual = np.linalg.norm(middle - 0.5 * values - cover.points, axis=1) + errors
    reach = (cover.radii + residual + _coordinate_rounding(cover.points, values)) * UP
    n_points = len(middle)
    radii, spread, found = reach.copy(), np.full(n_points, np.inf), np.zeros(n_points, dtype=bool)
    solved = SOLVED * (float(np.ptp(cover.points, axis=0).max(initial=0.0)) + np.abs(cover.points).sum(axis=1))
    hopeless = ~(residual <= np.maximum(cover.radii, solved))
    left = np.flatnonzero(np.isfinite(reach) & ~hopeless)
    sampled = 0.5 * symmetric_eigenvalues(field.gradient(middle[left]))[:, -1]
    steep = left[~(sampled < STEEPEST)]
    left, sampled = left[sampled < STEEPEST], sampled[sampled < STEEPEST]
    for widening in MIDPOINT_REACH:
        if not left.size:
            break
        factor = widening * np.maximum(1.0 / (1.0 - sampled), 1.0)
        half = factor * reach[left] * UP
        sigma = 0.5 * strain_ball_ranges(field, middle[left], half)[:, 1]
        passes = (1.0 - sigma) * factor > 1.0 + 1e-9
        done, own = left[passes], sigma[passes]
        radii[done] = np.minimum(factor[passes], (1.0 + 1e-9) / (1.0 - own)) * reach[done] * UP
        spread[done] = np.maximum(1.0, (1.0 + own) / (1.0 - own)) * reach[done] * UP
        found[done] = True
        left, sampled = left[~passes], sampled[~passes]
    left = np.concatenate([left, steep])
    radii[left], spread[left], found[left], hopeless[left] = _newton_balls(field, middle[left], reach[left])
    by_strain = found.copy()
    by_strain[left] = False
    _narrowed(field, middle, reach, np.flatnonzero(by_strain), radii, spread)
    return Midpoints(middle, radii, reach, spread, found, hopeless)


def _narrowed(field: Field, middle: Points, reach: Float, chosen: Int, radii: Float, spread: Float) -> None:
    """Take the balls of Newton-Kantorovich in place of those by strain, for ``chosen``, where they are smaller.

    Where both are found, they hold the same midpoint: the only one in the larger ball.
    """
    other, stretched, found, _ = _newton_balls(field, middle[chosen], reach[chosen])
    radii[chosen] = np.where(found & (other < radii[chosen]), other, radii[chosen])
    spread[chosen] = np.where(found & (stretched < spread[chosen]), stretched, spread[chosen])


def _newton_balls(field: Field, middle: Points, reach: Float) -> tuple[Float, Float, Bool, Bool]:
    """Radii around (N, n) places of balls that hold a midpoint each of what lies within ``reach`` of F there.

    Gives with them how far the step takes that from the image of the place, whether it is proved, and whether smaller
    reaches would not help.
    """
    eye = np.eye(middle.shape[1])
    matrices = eye - 0.5 * field.gradient(middle)
    matrices[~(np.abs(matrices).max(axis=(1, 2), initial=0.0) < LARGEST)] = 0.0
    known = np.abs(np.linalg.det(matrices)) > SINGULAR
    inverse = np.linalg.inv(np.where(known[:, None, None], matrices, eye))
    size = np.linalg.norm(inverse, 2, axis=(1, 2)) * UP
    radii = size * reach / (1.0 - NEWTON_CONTRACTION) * UP
    known &= np.isfinite(radii)
    gradients, off = gradient_ball_bounds(field, middle, np.where(known, radii, 0.0))
    known &= np.isfinite(gradients).all(axis=(1, 2)) & np.isfinite(off)
    gradients, off = np.where(known[:, None, None], gradients, 0.0), np.where(known, off, 0.0)
    apart = np.linalg.norm(eye - inverse @ (eye - 0.5 * gradients), axis=(1, 2))
    contraction = (apart + 0.5 * size * off + MATRIX_ROUNDING * size * (1.0 + np.abs(gradients).sum(axis=(1, 2)))) * UP
    found = known & (contraction <= NEWTON_CONTRACTION)
    ahead = eye + 0.5 * gradients[found]
    steep = np.linalg.norm(ahead, axis=(1, 2)) * UP
    spread = np.full(len(middle), np.inf)
    spread[found] = np.linalg.norm(ahead @ inverse[found], 2, axis=(1, 2)) * reach[found] * UP
    spread[found] += (contraction[found] * steep + 0.5 * off[found]) * radii[found]
    spread[found] += MATRIX_ROUNDING * size[found] * steep * reach[found]
    return radii, spread * UP, found, ~known


def cayley_image(field: Field, midpoints: Midpoints) -> Cover:
    """A cover of the image of the surface, from its midpoints."""
    values, errors = displacement_with_error(field, midpoints.points)
    moved = midpoints.points + 0.5 * values
    off = errors + _coordinate_rounding(midpoints.points, values)
    return Cover(moved, (midpoints.spread + off) * UP)


def solve(field: Field, targets: Points, *, factor: float, goals: Float, starts: Points | None = None) -> Points:
    """About the y with y + factor D(y) = target, for (N, n) targets, by damped Newton; to be checked by the caller.

    Begins at ``starts`` (N, n), mm, where they are given. Stops at residuals below ``goals`` (N,), mm, or at rounding.
    """
    n = targets.shape[1]
    solution = targets - factor * field.displacement(targets) if starts is None else starts.copy()
    best, size = solution.copy(), np.full(len(targets), np.inf)
    damping = np.ones(len(targets))
    active = np.arange(len(targets))
    goals = np.maximum(goals, 1e-13 * (1.0 + np.abs(targets).max(initial=0.0)))
    for _ in range(NEWTON_ITERATIONS):
        values, gradients = field.displacement_and_gradient(solution[active])
        residual = solution[active] + factor * values - targets[active]
        length = np.linalg.norm(residual, axis=1)
        better = length < size[active]
        damping[active] = np.where(better, 1.0, 0.5 * damping[active])
        best[active[better]], size[active[better]] = solution[active[better]], length[better]
        again = (length > goals[active]) & (damping[active] > 1e-3)
        active, residual, gradients = active[again], residual[again], gradients[again]
        if not active.size:
            break
        matrix = np.eye(n) + factor * gradients
        matrix[~(np.abs(np.linalg.det(matrix)) > 1e-12)] = np.eye(n)
        update = np.linalg.solve(matrix, residual[..., None])[..., 0]
        solution[active] -= damping[active, None] * update
    return best


def _coordinate_rounding(points: Points, values: Points) -> Float:
    size: Float = np.abs(points).sum(axis=1) + np.abs(values).sum(axis=1)
    return ROUNDING * size
