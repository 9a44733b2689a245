"""Fields of two parts: a radial sum in all of space, and a local part without divergence that corrects it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from musclefit.fields.enclosures import radial as enclosures
from musclefit.fields.enclosures.cell_bounds import GRADIENT, STRAIN
from musclefit.fields.radial import RadialField
from musclefit.fields.solenoidal import SolenoidalField
from musclefit.geometry.arrays import Bool, Float, Gradients, Points

ROUNDING = 1e-13
"""Of computed eigenvalues, in units of the sum of a matrix's entries."""

WEAK = 0.02
"""Where no eigenvalue of the local part's strain is larger, the radial part is judged alone and this added."""


@dataclass(frozen=True, eq=False, slots=True)
class CorrectedField:
    """D(x) = radial(x) + local(x).

    Parameters
    ----------
    radial : RadialField
        In space.
    local : SolenoidalField
    """

    radial: RadialField
    local: SolenoidalField

    @classmethod
    def of(cls, base: RadialField | CorrectedField, local: SolenoidalField) -> Self:
        """A field with a local part added to it, beside its own if it has one."""
        if isinstance(base, CorrectedField):
            return cls(base.radial, base.local.beside(local))
        return cls(base, local)

    def displacement(self, points: Points) -> Points:
        """(N, 3) displacements at (N, 3) points, mm."""
        values: Points = self.radial.displacement(points) + self.local.displacement(points)
        return values

    def gradient(self, points: Points) -> Gradients:
        """(N, 3, 3) derivatives."""
        return self.displacement_and_gradient(points)[1]

    def displacement_and_gradient(self, points: Points) -> tuple[Points, Gradients]:
        """Both in one pass."""
        values, gradients = self.radial.displacement_and_gradient(points)
        more, steeper = self.local.displacement_and_gradient(points)
        values += more
        gradients += steeper
        return values, gradients

    def scaled(self, factor: float) -> Self:
        """The field ``factor`` times as strong."""
        return type(self)(self.radial.scaled(factor), self.local.scaled(factor))

    def prepared(self) -> Self:
        """The same field, of which nothing is known yet: see `SolenoidalField.prepared`."""
        return type(self)(self.radial, self.local.prepared())

    def gradient_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float]:
        """Rigorous enclosure of the gradient over boxes: see `protocol.Field`."""
        return self._with_local(*self.radial.gradient_bounds(centres, half_widths), centres, half_widths)

    def gradient_and_spreads(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float, Float]:
        """Gradients at the centres, and how far those of a box are from that, as matrices and by their strain.

        Cheaper than ``gradient_bounds``, and not much wider where boxes are narrow for the local part's lattices.
        """
        gradients, radii = self.radial.gradient_bounds(centres, half_widths)
        more, spread, strained = self.local.gradient_and_spreads(centres, half_widths)
        rounding = radii + ROUNDING * (np.abs(gradients) + np.abs(more)).sum(axis=(1, 2))
        return gradients + more, (spread + rounding) * (1.0 + 1e-15), (strained + rounding) * (1.0 + 1e-15)

    def gradient_ball_bounds(self, centres: Points, radii: Float) -> tuple[Gradients, Float]:
        """As ``gradient_bounds``, over (B,) balls."""
        half_widths = enclosures.cubes(radii, centres.shape[1])
        return self._with_local(*self.radial.gradient_ball_bounds(centres, radii), centres, half_widths)

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Rigorous bounds of the eigenvalues of the gradient's symmetric part over boxes.

        As `RadialField.strain_bounds`, which judges the boxes that the local part does not touch.
        """
        ceilings = self.local.ceilings(centres, half_widths)[:, STRAIN]
        ranges, middles = np.empty((len(centres), 2)), np.empty((len(centres), 2))
        weak = ceilings <= WEAK
        if weak.any():
            room = (enough[0] + WEAK, enough[1] - WEAK)
            alone, middles[weak] = self.radial.strain_bounds(centres[weak], half_widths[weak], enough=room)
            ranges[weak] = _widened(alone, ceilings[weak])
        if not weak.all():
            strong = np.flatnonzero(~weak)
            gradients, radii = self.radial.gradient_bounds(centres[strong], half_widths[strong])
            found = _ranges_of(gradients, radii + ceilings[strong])
            more = ~((found[:, 0] >= enough[0]) & (found[:, 1] <= enough[1]))
            hard = strong[more]
            found[more] = enclosures.narrower(
                found[more], self._strain(gradients[more], radii[more], centres[hard], half_widths[hard])
            )
            ranges[strong] = found
        touched = ceilings > 0.0
        there = self.gradient(centres[touched])
        middles[touched] = np.linalg.eigvalsh(0.5 * (there + there.transpose(0, 2, 1)))[:, [0, -1]]
        return ranges, middles

    def strain_ball_bounds(self, centres: Points, radii: Float) -> tuple[Float, Float]:
        """As ``strain_bounds``, over (B,) balls."""
        half_widths = enclosures.cubes(radii, centres.shape[1])
        ceilings = self.local.ceilings(centres, half_widths)[:, STRAIN]
        ranges, middles = np.empty((len(centres), 2)), np.full((len(centres), 2), np.nan)
        weak = ceilings <= WEAK
        if weak.any():
            alone, of_radial = self.radial.strain_ball_bounds(centres[weak], radii[weak])
            ranges[weak] = _widened(alone, ceilings[weak])
            middles[weak] = np.where(ceilings[weak, None] > 0.0, np.nan, of_radial)
        if not weak.all():
            gradients, off = self.radial.gradient_ball_bounds(centres[~weak], radii[~weak])
            ranges[~weak] = enclosures.narrower(
                _ranges_of(gradients, off + ceilings[~weak]),
                self._strain(gradients, off, centres[~weak], half_widths[~weak]),
            )
        return ranges, middles

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Rigorous enclosure of the displacement over boxes: values at the centres and radii, (B, n) each, mm."""
        values, radii = self.radial.displacement_bounds(centres, half_widths)
        steepest = self.local.ceilings(centres, half_widths)[:, GRADIENT]
        more = steepest * np.linalg.norm(half_widths, axis=1) * (1.0 + 1e-14) + self.local.displacement_rounding(
            centres
        )
        local = self.local.displacement(centres)
        # 1e-15: of the two sums.
        rounding = 1e-15 * (np.abs(values) + np.abs(local) + radii)
        return values + local, radii + more[:, None] + rounding

    def _with_local(
        self, gradients: Gradients, radii: Float, centres: Points, half_widths: Float
    ) -> tuple[Gradients, Float]:
        known: Bool = np.asarray(np.isfinite(gradients).all(axis=(1, 2)), dtype=np.bool_)
        sums, found = self.local.bounds_with(
            np.where(known[:, None, None], gradients, 0.0), centres, half_widths, strain=False
        )
        return sums, np.where(known, (found[:, 0] + radii) * (1.0 + 1e-15), np.inf)

    def _strain(self, gradients: Gradients, radii: Float, centres: Points, half_widths: Float) -> Float:
        known: Bool = np.asarray(np.isfinite(gradients).all(axis=(1, 2)) & np.isfinite(radii), dtype=np.bool_)
        sums, found = self.local.bounds_with(
            np.where(known[:, None, None], gradients, 0.0), centres, half_widths, strain=True
        )
        off = (np.where(known, radii, np.inf) + ROUNDING * np.abs(sums).sum(axis=(1, 2)))[:, None]
        ranges: Float = np.concatenate([-found[:, :1] - off, found[:, 1:] + off], axis=1)
        return ranges


def _widened(ranges: Float, by: Float) -> Float:
    """Ranges of eigenvalues of sums with symmetric matrices whose eigenvalues are at most ``by`` (B,) in size."""
    wider: Float = np.stack([ranges[:, 0] - by, ranges[:, 1] + by], axis=1)
    wider += 1e-15 * np.abs(wider) * np.array([-1.0, 1.0])
    return wider


def _ranges_of(gradients: Gradients, radii: Float) -> Float:
    """Ranges of the strain's eigenvalues, from enclosures of the gradient."""
    known = np.isfinite(gradients).all(axis=(1, 2)) & np.isfinite(radii)
    ranges = np.tile([-np.inf, np.inf], (len(gradients), 1))
    kept = gradients[known]
    values: Float = np.asarray(np.linalg.eigvalsh(0.5 * (kept + kept.transpose(0, 2, 1)))[:, [0, -1]], np.float64)
    ranges[known] = _widened(values, radii[known] + ROUNDING * np.abs(kept).sum(axis=(1, 2)) + 1e-280)
    return ranges
