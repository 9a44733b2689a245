"""Chooses views that show a body whole, along its principal axes; knows points, not tissues."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from musclefit.geometry.arrays import Float, Points

_MARGIN = 1.06
"""Share of the panel's half height that the body's half height may take is one over this."""


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """A parallel view.

    ``right``, ``up`` and ``towards`` (from the body to the eye) are right-handed unit vectors; ``half_width_mm`` and
    ``half_height_mm`` are the extent seen from ``centre``.
    """

    centre: Float
    right: Float
    up: Float
    towards: Float
    half_width_mm: float
    half_height_mm: float
    half_depth_mm: float

    @property
    def aspect(self) -> float:
        """Width over height of what is seen."""
        return self.half_width_mm / self.half_height_mm

    def parallel_scale_mm(self, panel_aspect: float) -> float:
        """Half height of the panel, mm, so that all is seen in a panel of that width over height."""
        return _MARGIN * max(self.half_height_mm, self.half_width_mm / panel_aspect)


def principal_axis(points: Points) -> Float:
    """Unit vector of the longest extent of (n, 3) points."""
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return _positive(axes[:, -1])


def principal_views(points: Points) -> tuple[View, View]:
    """Two views with the longest extent upright: first the broad face, then a quarter turn about the upright axis.

    Parameters
    ----------
    points : (n, 3) float64, mm

    Returns
    -------
    tuple of two View
        Deterministic: the signs of the axes follow their largest components, upright is towards +z where it can be.
    """
    centred = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False) if len(points) >= 3 else (0, 0, np.eye(3))
    up, right = _positive(axes[0]), _positive(axes[1])
    towards = np.cross(right, up)
    return _framed(points, right, up, towards), _framed(points, -towards, up, right)


def views_around(points: Points, *, count: int) -> tuple[View, ...]:
    """Views all round the longest extent, evenly spaced from the broad face on, all of one scale and one centre.

    Parameters
    ----------
    points : (n, 3) float64, mm
    count : int
    """
    first = principal_views(points)[0]
    turns = 2.0 * np.pi * np.arange(count) / count
    rights = [np.cos(turn) * first.right - np.sin(turn) * first.towards for turn in turns]
    widest = max(float(np.abs((points - first.centre) @ right).max()) for right in rights)
    return tuple(
        replace(first, right=right, towards=np.cross(right, first.up), half_width_mm=widest, half_depth_mm=widest)
        for right in rights
    )


def _positive(axis: Float) -> Float:
    """The axis or its opposite: towards +z where z has a say in it, else with a positive largest component."""
    lead = 2 if abs(axis[2]) > 0.25 else int(np.argmax(np.abs(axis)))
    return axis if axis[lead] > 0 else -axis


def _framed(points: Points, right: Float, up: Float, towards: Float) -> View:
    axes = np.stack([right, up, towards])
    along = points @ axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    half = np.maximum((high - low) / 2.0, 1e-6 * max(1.0, float(np.abs(along).max())))
    return View(
        centre=((low + high) / 2.0) @ axes,
        right=right,
        up=up,
        towards=towards,
        half_width_mm=float(half[0]),
        half_height_mm=float(half[1]),
        half_depth_mm=float(half[2]),
    )
