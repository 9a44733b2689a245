"""A body's geometry before and after a map -> the factors of its three axes that come nearest to the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points, frozen
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh


@dataclass(frozen=True, eq=False, slots=True)
class AxisFactors:
    """x -> factors * x + offset in a body's own frame: (3,) factors, (3,) offset in mm."""

    factors: Float
    offset: Points

    def __post_init__(self) -> None:
        object.__setattr__(self, "factors", frozen(self.factors))
        object.__setattr__(self, "offset", frozen(self.offset))


def axis_factors(surface: TriMesh, moved: Points, *, name: str) -> AxisFactors:
    r"""Fit one factor and one offset to each axis by least squares, area for area.

    .. math:: \min_{s, t} \int (s\,x_k + t - y_k)^2 \, dA

    with the integral taken by the middles of the triangles.

    Parameters
    ----------
    surface : TriMesh
        In the body's frame, mm; it need not be closed.
    moved : (n, 3) float64, mm
        Where the map takes its vertices, along the same axes.
    name : str
        Of the body, for the message.

    Raises
    ------
    InputError
        A surface that has no extent along an axis, or that is turned so far that a factor is not positive.
    """
    areas = np.linalg.norm(area_vectors(surface), axis=1)
    before, after = (points[surface.faces].mean(axis=1) for points in (surface.vertices, moved))
    if not areas.sum() > 0.0:
        raise InputError(f"body {name!r}: its geometry has no area, so no linear factors fit; leave it to the map")
    centre, there = (np.average(points, axis=0, weights=areas) for points in (before, after))
    spread = areas @ (before - centre) ** 2
    if not (spread > 1e-12 * spread.max()).all():
        flat = "xyz"[int(spread.argmin())]
        raise InputError(
            f"body {name!r}: its geometry has no extent along {flat}, so no factor fits there; leave it to the map"
        )
    factors = areas @ ((before - centre) * (after - there)) / spread
    if not (factors > 0.0).all():
        raise InputError(
            f"body {name!r}: its best linear factors are {' '.join(f'{f:.3g}' for f in factors)}; all must be above 0. "
            "The map turns this bone, and linear scaling cannot: register the subject to the model's default pose, or "
            "leave this body to the map"
        )
    return AxisFactors(factors, there - factors * centre)
