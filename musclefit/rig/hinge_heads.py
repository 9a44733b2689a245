"""The head of a hinge: samples of a surface in; the side it overhangs its shaft to and what turns past the joint, out.

A hinge of long bones bends to one side from straight. The surface of its head that the other bone slides over goes on
to that side, so the head is set off to it from the shaft: the condyles of a femur backwards, the trochlea of a humerus
forwards, the head of a phalanx to the palm. What lies on the other side may be round as well, but about another axis,
as the groove of the kneecap is.

References: Eckhoff et al., Three-dimensional mechanics, kinematics, and morphology of the knee viewed in virtual
reality, J Bone Joint Surg Am 87 Suppl 2 (2005); Most et al., Sensitivity of the knee joint kinematics calculation to
selection of flexion axes, J Biomech 37 (2004).
"""

from __future__ import annotations

import numpy as np

from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.geometry.quantiles import weighted_quantile

SHAFT = (3.0, 8.0)
"""From where to where a bone is taken for the shaft of its head: distance from the joint's middle, in times the
joint's size."""

HEAD = 2.0
"""What is nearer than this is the head, in times the joint's size."""

LONG_SHAFT = 2.0
"""Least length of a shaft whose direction counts, in times the joint's size."""

CLEARLY = 0.3
"""A head overhangs to a side by so much more than to the other, in times the joint's size."""

OUTERMOST = 0.02
"""Share of the area that is left out at either end of a range."""

TURN_DEG = (-15.0, 120.0)
"""What turns past the joint, as angles about the axis from the middle of what faces: a hinge of limbs bends by 120
degrees or more, and is not quite straight at rest."""

BEYOND = 0.1
"""How far beyond what faces, along the axis, a surface still belongs to it: in times the length of what faces."""

AROUND_DEG = 20.0
"""The same about the axis for the bone that has no head, degrees."""


def outwardness(points: Points, normals: Points, areas: Float, *, at: Points, along: Float) -> float:
    """How far a surface's normals point away from an axis: the mean cosine, near 1 for a head and near -1 for a cup.

    Parameters
    ----------
    points, normals : (n, 3) float64, mm and of length 1
    areas : (n,) float64, mm²
    at, along : (3,) float64
        A point of the axis, mm, and its direction, of length 1.
    """
    way = points - at
    way = way - np.outer(way @ along, along)
    cosines = np.einsum("ni,ni->n", normals, way) / np.maximum(np.linalg.norm(way, axis=1), 1e-12)
    return float(np.average(cosines, weights=areas))


def overhanging_side(points: Points, areas: Float, *, middle: Points, along: Float, size: float) -> Float | None:
    """To which side of its shaft a bone's head is set off, at right angles to an axis.

    The shaft is followed as a strip of even width, seen along the axis, to where the head is.

    Parameters
    ----------
    points : (n, 3) float64, mm
        Of the bone's surface, at least as far as `SHAFT` reaches.
    areas : (n,) float64, mm²
    middle : (3,) float64, mm
        Of what faces the other bone.
    along : (3,) float64
        The axis' direction, of length 1.
    size : float
        The joint's, mm.

    Returns
    -------
    (3,) float64 of length 1, or None
        None where there is no shaft, or the head overhangs to both sides alike (`CLEARLY`).
    """
    away = np.linalg.norm(points - middle, axis=1)
    shaft = (away > SHAFT[0] * size) & (away < SHAFT[1] * size)
    head = away < HEAD * size
    if not shaft.any() or not head.any():
        return None
    centre = np.average(points[shaft], axis=0, weights=areas[shaft])
    side = np.cross(along, middle - centre)
    if np.linalg.norm(side) < size:
        return None
    side = side / np.linalg.norm(side)
    up = np.cross(side, along)
    height, across = (points - centre) @ up, (points - centre) @ side
    if np.ptp(height[shaft]) < LONG_SHAFT * size:
        return None
    weights = areas[shaft]
    slope = float(np.sum(weights * height[shaft] * across[shaft]) / np.sum(weights * height[shaft] ** 2))
    off = across - slope * height
    low, high = _range(off[shaft], weights)
    lowest, highest = _range(off[head], areas[head])
    more = (highest - high) - (low - lowest)
    if abs(more) <= CLEARLY * size:
        return None
    towards: Float = side if more > 0.0 else -side
    return towards


def turned_past(
    points: Points,
    facing: Points,
    facing_areas: Float,
    *,
    at: Points,
    along: Float,
    middle: Points,
    side: Float | None,
) -> Bool:
    """Which places turn past the joint as a hinge bends.

    Parameters
    ----------
    points : (n, 3) float64, mm
    facing : (k, 3) float64, mm
        Where the bone faces the other one at rest.
    facing_areas : (k,) float64, mm²
    at, along : (3,) float64
        A point of the axis, mm, and its direction, of length 1.
    middle : (3,) float64, mm
        Of what faces; not on the axis.
    side : (3,) float64 or None
        To which the bone's head goes on; None for the bone that slides over it, of which what faces is what counts.

    Returns
    -------
    (n,) bool
    """
    outwards = middle - at
    outwards = outwards - (outwards @ along) * along
    outwards = outwards / max(float(np.linalg.norm(outwards)), 1e-12)
    across = np.cross(along, outwards)
    if side is not None and across @ side < 0.0:
        across = -across

    def turns(places: Points) -> Float:
        angles: Float = np.degrees(np.arctan2((places - at) @ across, (places - at) @ outwards))
        return angles

    first, last = TURN_DEG
    if side is None:
        first, last = _range(turns(facing), facing_areas)
        first, last = first - AROUND_DEG, last + AROUND_DEG
    low, high = _range((facing - at) @ along, facing_areas)
    beyond = BEYOND * (high - low)
    heights, angles = (points - at) @ along, turns(points)
    within: Bool = (heights > low - beyond) & (heights < high + beyond) & (angles > first) & (angles < last)
    return within


def _range(values: Float, weights: Float) -> tuple[float, float]:
    return weighted_quantile(values, weights, OUTERMOST), weighted_quantile(values, weights, 1.0 - OUTERMOST)
