"""Wrap objects after a map: sample the surface, move the samples, fit the same kind of surface to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.rigid import RigidMotion

AROUND, ALONG = 24, 9


@dataclass(frozen=True, eq=False, slots=True)
class FittedWrap:
    """Place and sizes (mm) of a wrap object, and how far the moved samples are from it, rms and at most, mm."""

    place: RigidMotion
    sizes_mm: Float
    rms_mm: float
    largest_mm: float


def wrap_samples(kind: str, sizes: Float) -> Points:
    """(n, 3) points of a wrap object's surface in its own frame, mm; a cylinder's axis is z, a torus's too."""
    turn = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    if kind == "WrapCylinder":
        along, turns = np.meshgrid(np.linspace(-0.5, 0.5, ALONG) * sizes[1], turn)
        return np.stack([sizes[0] * np.cos(turns), sizes[0] * np.sin(turns), along], axis=-1).reshape(-1, 3)
    tilt, turns = np.meshgrid(np.linspace(-0.45, 0.45, ALONG) * np.pi, turn)
    if kind == "WrapTorus":
        middle, tube = sizes[1], sizes[0]
        ring = middle + tube * np.cos(2.0 * tilt)
        return np.stack([ring * np.cos(turns), ring * np.sin(turns), tube * np.sin(2.0 * tilt)], axis=-1).reshape(-1, 3)
    ball = np.stack([np.cos(tilt) * np.cos(turns), np.cos(tilt) * np.sin(turns), np.sin(tilt)], axis=-1)
    return ball.reshape(-1, 3) * np.broadcast_to(sizes, 3)


def fitted_wrap(kind: str, sizes: Float, *, samples: Points, moved: Points) -> FittedWrap:
    """Fit a wrap object to its moved samples.

    The affine map that is nearest to the motion of the samples (least squares) says place and orientation, by its
    translation and rotation (polar decomposition), and the sizes, by how much it stretches the object's own axes.

    Parameters
    ----------
    kind : str
        WrapCylinder (radius, length), WrapSphere (radius), WrapEllipsoid (three), WrapTorus (inner, outer radius).
    sizes : (k,) float64, mm
    samples, moved : (n, 3) float64, mm
        In the object's own frame, and where they went in the ground's.
    """
    rows = np.column_stack([samples, np.ones(len(samples))])
    solution = np.linalg.lstsq(rows, moved, rcond=None)[0]
    linear, centre = solution[:3].T, solution[3]
    left, _, right = np.linalg.svd(linear)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    stretch = np.diag(rotation.T @ linear)
    across = float(np.sqrt(stretch[0] * stretch[1]))
    factors: dict[str, Float] = {
        "WrapCylinder": np.array([across, stretch[2]]),
        "WrapSphere": np.cbrt(stretch.prod()) * np.ones(1),
        "WrapEllipsoid": stretch,
        "WrapTorus": across * np.ones(2),
    }
    new = sizes * factors[kind]
    place = RigidMotion(rotation, centre)
    off = np.linalg.norm(place(wrap_samples(kind, new)) - moved, axis=1)
    return FittedWrap(place, new, float(np.sqrt((off**2).mean())), float(off.max()))
