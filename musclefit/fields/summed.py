"""Sums of a field and splines on lattices: what a whole body does, and what brings it into line with its bones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from musclefit.fields.enclosures import radial as enclosures
from musclefit.fields.ffd import FfdField
from musclefit.fields.protocol import Field
from musclefit.geometry.arrays import Bool, Float, Gradients, Points

ROUNDING = 1e-13
"""Of sums and of computed eigenvalues, in units of what they are made of."""


class BoundedField(Field, Protocol):
    """A field that bounds its strain and its values, beside its gradient."""

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Proved eigenvalue ranges over boxes and about those at their centres, (B, 2) each."""
        ...

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Displacements at the centres of boxes and radii, (B, n) each, mm."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class SummedField:
    """D(x) = first(x) + splines(x).

    Parameters
    ----------
    first : BoundedField
    splines : FfdField
    """

    first: BoundedField
    splines: FfdField

    def displacement(self, points: Points) -> Points:
        """(N, n) displacements at (N, n) points, mm."""
        values: Points = self.first.displacement(points) + self.splines.displacement(points)
        return values

    def gradient(self, points: Points) -> Gradients:
        """(N, n, n) derivatives."""
        return self.displacement_and_gradient(points)[1]

    def displacement_and_gradient(self, points: Points) -> tuple[Points, Gradients]:
        """Both in one pass."""
        values, gradients = self.first.displacement_and_gradient(points)
        more, steeper = self.splines.displacement_and_gradient(points)
        return values + more, gradients + steeper

    def scaled(self, factor: float) -> Self:
        """The field ``factor`` times as strong."""
        return type(self)(self.first.scaled(factor), self.splines.scaled(factor))

    def gradient_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float]:
        """Rigorous enclosure of the gradient over boxes: see `protocol.Field`."""
        gradients, radii = self.first.gradient_bounds(centres, half_widths)
        known = _known(gradients, radii)
        sums, found = self._with_splines(gradients, known, centres, half_widths, strain=False)
        rounding = ROUNDING * np.abs(sums).sum(axis=(1, 2))
        return sums, np.where(known, (found[:, 0] + np.where(known, radii, 0.0) + rounding) * (1.0 + 1e-14), np.inf)

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Rigorous bounds of the eigenvalues of the gradient's symmetric part over boxes.

        The splines' are tight around the first field's gradient at the centre, from which that gets as far as its
        radius says. Where this is not enough, the ranges of the two are added too.
        """
        gradients, radii = self.first.gradient_bounds(centres, half_widths)
        known = _known(gradients, radii)
        sums, found = self._with_splines(gradients, known, centres, half_widths, strain=True)
        off = np.where(known, radii + ROUNDING * np.abs(sums).sum(axis=(1, 2)), np.inf)
        ranges = np.stack([-found[:, 0] - off, found[:, 1] + off], axis=1)
        middles = np.linalg.eigvalsh(0.5 * (sums + sums.transpose(0, 2, 1)))[:, [0, -1]]
        middles[~known] = np.nan
        short = np.flatnonzero(~((ranges[:, 0] >= enough[0]) & (ranges[:, 1] <= enough[1])))
        if short.size:
            here, half = np.ascontiguousarray(centres[short]), np.ascontiguousarray(half_widths[short])
            added = self.first.strain_bounds(here, half, enough=enough)[0]
            added = added + self.splines.strain_bounds(here, half, enough=enough)[0]
            slack = 1e-15 * np.abs(added) * np.array([-1.0, 1.0])
            ranges[short] = enclosures.narrower(ranges[short], added + slack)
        return ranges, np.asarray(middles, dtype=np.float64)

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Rigorous enclosure of the displacement over boxes: values at the centres and radii, (B, n) each, mm."""
        values, radii = self.first.displacement_bounds(centres, half_widths)
        more, wider = self.splines.displacement_bounds(centres, half_widths)
        rounding = 1e-15 * (np.abs(values) + np.abs(more) + radii + wider)  # of the two sums
        return values + more, radii + wider + rounding

    def _with_splines(
        self, gradients: Gradients, known: Bool, centres: Points, half_widths: Float, *, strain: bool
    ) -> tuple[Gradients, Float]:
        """The splines' bounds around the first field's gradients, and around nothing where these are not known."""
        around = np.where(known[:, None, None], gradients, 0.0) + self.splines.linear
        return self.splines.bounds_with(around, centres, half_widths, strain=strain)


def _known(gradients: Gradients, radii: Float) -> Bool:
    known: Bool = np.isfinite(gradients).all(axis=(1, 2)) & np.isfinite(radii)
    return known
