"""How far a model's markers are from those that were recorded, and what the recording leaves open; knows no file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.rig.multibody import CoordinateKind, Multibody

_TURN_RAD, _SLIDE_M = 1e-4, 1e-4
"""Differences by which markers' dependence on coordinates is found."""
OPEN_MM = 1e-3
"""A radian, or a metre, of a direction of coordinates that moves markers by less than this, mm rms, is left open."""


@dataclass(frozen=True, eq=False, slots=True)
class MarkerResiduals:
    """Distances of markers of a model in its poses from recorded ones.

    Parameters
    ----------
    names : tuple of str, length m
    times_s : (f,) float64
    off_mm : (f, m) float64
        Not a number where a marker was not seen.
    """

    names: tuple[str, ...]
    times_s: Float
    off_mm: Float

    @property
    def rms_mm(self) -> float:
        """Over all frames and markers."""
        return float(np.sqrt(np.nanmean(self.off_mm**2)))

    def of(self, name: str) -> tuple[float, float, float]:
        """A marker's rms and largest residual, mm, and when that is, s."""
        column = self.off_mm[:, self.names.index(name)]
        worst = int(np.nanargmax(column))
        return float(np.sqrt(np.nanmean(column**2))), float(column[worst]), float(self.times_s[worst])

    @property
    def worst(self) -> tuple[str, float, float]:
        """The marker with the largest residual, that in mm, and when, s."""
        name = self.names[int(np.nanargmax(np.nanmax(self.off_mm, axis=0)))]
        return name, *self.of(name)[1:]


def marker_places(multibody: Multibody, markers: Sequence[tuple[str, Points]], values: Mapping[str, float]) -> Points:
    """(m, 3) places in the ground, mm, of markers on bodies, each a body and (3,) a place there."""
    places = multibody.places(values)
    return np.stack([places[body](at[None])[0] for body, at in markers])


def open_coordinates(
    multibody: Multibody, markers: Sequence[tuple[str, Points]], values: Mapping[str, float], *, seen: Bool
) -> tuple[str, ...]:
    """Free coordinates that the markers that were ``seen``, (m,), do not fix at a pose, to first order."""
    coupled = {coupler.dependent for coupler in multibody.couplers}
    free = [name for name, of in multibody.coordinates.items() if not of.locked and name not in coupled]
    columns = []
    for name in free:
        step = _TURN_RAD if multibody.coordinates[name].kind is not CoordinateKind.TRANSLATIONAL else _SLIDE_M
        ends = [marker_places(multibody, markers, {**values, name: values[name] + way})[seen] for way in (step, -step)]
        columns.append((ends[0] - ends[1]).ravel() / (2.0 * step))
    if not columns:
        return ()
    _, sizes, ways = np.linalg.svd(np.stack(columns, axis=1) / np.sqrt(max(int(seen.sum()), 1)))
    fixed = int((sizes > OPEN_MM).sum())
    loose = np.abs(ways[fixed:]).max(axis=0, initial=0.0)
    return tuple(name for name, share in zip(free, loose.tolist(), strict=True) if share > 0.05)
