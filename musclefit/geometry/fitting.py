"""Spheres and cylinders that fit weighted points best, with what they leave over; knows no joint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points, frozen

FIT_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False, slots=True)
class SphereFit:
    """A sphere; ``residuals`` (n,) are distances of points from it, mm, positive outside, ``weights`` (n,) theirs."""

    centre: Points
    radius: float
    residuals: Float
    weights: Float

    @property
    def rms(self) -> float:
        """Root mean square of the residuals by their weights, mm."""
        return _rms(self.residuals, self.weights)


@dataclass(frozen=True, eq=False, slots=True)
class CylinderFit:
    """A cylinder by a point and the direction of its axis (length 1); ``residuals`` and ``weights`` as of `SphereFit`.

    ``spread`` is how far the points reach around the axis, degrees: below about 60 an axis is uncertain.
    """

    centre: Points
    axis: Float
    radius: float
    residuals: Float
    weights: Float
    spread: float

    @property
    def rms(self) -> float:
        """Root mean square of the residuals by their weights, mm."""
        return _rms(self.residuals, self.weights)


def fitted_sphere(points: Points, *, weights: Float | None = None) -> SphereFit:
    """The sphere with the least weighted sum of squared distances to (n, 3) points, mm.

    Starts from the algebraic fit, which is linear.

    Parameters
    ----------
    points : (n, 3) float64, mm
    weights : (n,) float64 or None
        Positive, such as the areas that the points stand for; None: all alike.

    Raises
    ------
    InputError
        Fewer than four points, or points in a plane.
    """
    if len(points) < 4:
        raise InputError(f"{len(points)} points fit many spheres; give at least 4 that are not in a plane")
    origin = points.mean(axis=0)
    p = points - origin
    if np.linalg.svd(p, compute_uv=False)[-1] < 1e-9 * max(np.abs(p).max(), 1e-300):
        raise InputError(f"the {len(points)} points lie in a plane and fit many spheres; add points off the plane")
    share, roots = _shares(weights, len(p))
    linear = np.column_stack([2.0 * p, np.ones(len(p))])
    solution = np.linalg.lstsq(roots[:, None] * linear, roots * (p**2).sum(axis=1), rcond=None)[0]
    centre = solution[:3]
    radius = float(np.sqrt(max(solution[3] + centre @ centre, 0.0)))

    def residuals(x: Float) -> Float:
        return np.asarray(np.linalg.norm(p - x[:3], axis=1) - x[3])

    def weighted(x: Float) -> Float:
        return roots * residuals(x)

    best = least_squares(weighted, [*centre, radius], xtol=FIT_TOLERANCE, ftol=FIT_TOLERANCE).x
    return SphereFit(frozen(best[:3] + origin), float(best[3]), frozen(residuals(best)), frozen(share))


def fitted_cylinder(
    points: Points, normals: Points, *, weights: Float | None = None, near: Float | None = None
) -> CylinderFit:
    """The cylinder with the least weighted sum of squared distances to (n, 3) points, mm.

    Starts from the direction that the (n, 3) ``normals`` of the surface are most at right angles to: a cylinder's are
    to its axis.

    Parameters
    ----------
    points : (n, 3) float64, mm
    normals : (n, 3) float64
    weights : (n,) float64 or None
        Positive, such as the areas that the points stand for; None: all alike.
    near : (3,) float64 or None
        Where the axis points roughly, if that is known: the search starts there alone.

    Raises
    ------
    InputError
        Fewer than six points.
    """
    if len(points) < 6:
        raise InputError(f"{len(points)} points fit many cylinders; give at least 6")
    origin = points.mean(axis=0)
    p = points - origin
    share, roots = _shares(weights, len(p))
    starts = np.linalg.svd(roots[:, None] * normals, full_matrices=False)[2][::-1] if near is None else [near]
    best = min((_cylinder_from(p, roots, axis) for axis in starts), key=lambda fit: fit[1])[0]
    axis, centre, radius = best
    off = p - centre
    flat = off - np.outer(off @ axis, axis)
    residuals = np.linalg.norm(flat, axis=1) - radius
    centre = centre + weighted_quantile(off @ axis, share, 0.5) * axis
    spread = _spread(flat, axis)
    return CylinderFit(frozen(centre + origin), frozen(axis), radius, frozen(residuals), frozen(share), spread)


def weighted_quantile(values: Float, weights: Float, share: float) -> float:
    """The least of (n,) values below or at which a share of all (n,) weights lies."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(below, share * below[-1])), len(values) - 1)]])


def _shares(weights: Float | None, count: int) -> tuple[Float, Float]:
    """Weights whose mean is 1, and their square roots."""
    share: Float = np.ones(count) if weights is None else weights / weights.mean()
    return share, np.sqrt(share)


def _rms(residuals: Float, weights: Float) -> float:
    return float(np.sqrt(np.average(residuals**2, weights=weights)))


def _cylinder_from(p: Points, roots: Float, start: Float) -> tuple[tuple[Float, Points, float], float]:
    """The best cylinder near a direction, and its sum of squares."""
    u, v = _across(start)

    def frame(x: Float) -> tuple[Float, Float, Float]:
        axis = start + x[0] * u + x[1] * v
        axis = axis / np.linalg.norm(axis)
        across = u - (u @ axis) * axis
        across = across / np.linalg.norm(across)
        return axis, across, np.cross(axis, across)

    def residuals(x: Float) -> Float:
        _, across, other = frame(x)
        return np.asarray(roots * (np.hypot(p @ across - x[2], p @ other - x[3]) - x[4]))

    flat = np.column_stack([p @ u, p @ v])
    linear = np.column_stack([2.0 * flat, np.ones(len(p))])
    circle = np.linalg.lstsq(roots[:, None] * linear, roots * (flat**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(max(circle[2] + circle[:2] @ circle[:2], 0.0)))
    found = least_squares(
        residuals, [0.0, 0.0, *circle[:2], radius], xtol=FIT_TOLERANCE, ftol=FIT_TOLERANCE, x_scale="jac", method="lm"
    )
    axis, across, other = frame(found.x)
    return (axis, found.x[2] * across + found.x[3] * other, float(found.x[4])), float(found.cost)


def _across(axis: Float) -> tuple[Float, Float]:
    """Two directions at right angles to an axis and to each other."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    u = np.cross(axis, helper)
    u = u / np.linalg.norm(u)
    return u, np.cross(axis, u)


def _spread(flat: Points, axis: Float) -> float:
    """360 degrees less the widest gap between the directions of points around an axis."""
    u, v = _across(axis)
    angles = np.sort(np.arctan2(flat @ v, flat @ u))
    gaps = np.diff(np.append(angles, angles[0] + 2.0 * np.pi))
    return float(np.degrees(2.0 * np.pi - gaps.max()))
