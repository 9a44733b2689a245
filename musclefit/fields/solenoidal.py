"""Displacement fields that are curls of cubic B-spline vector potentials: without divergence, local, and cheap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from musclefit.errors import FieldError
from musclefit.fields.enclosures import solenoidal as solenoidal_bounds
from musclefit.fields.enclosures.cell_bounds import BEND, GRADIENT, KINDS, STRAIN, STRAIN_BEND, Ceilings
from musclefit.fields.evaluation import potentials
from musclefit.geometry.arrays import Float, Gradients, Int, Points, frozen

MAX_LATTICE_POINTS = 400_000_000
"""Lattice points of one level at most, used or not; 1.6 GB."""

WEAK = 1e-3
"""Of the eigenvalues of a level's strain in a box: up to this they are bounded by the level's ceiling alone."""

_Lattices = tuple[Float, Float, Int, NDArray[np.int32], Points]


@dataclass(frozen=True, eq=False, slots=True)
class PotentialLevel:
    """Cubic B-splines of a vector potential at some points of a lattice.

    Parameters
    ----------
    low : (3,) float64, mm
        The first lattice point.
    spacing_mm : float
    numbers : (n0, n1, n2) int32
        Row of each lattice point's coefficients, or -1.
    coefficients : (K, 3) float64, mm²
    """

    low: Float
    spacing_mm: float
    numbers: NDArray[np.int32]
    coefficients: Points

    def __post_init__(self) -> None:
        object.__setattr__(self, "low", frozen(self.low))
        object.__setattr__(self, "coefficients", frozen(self.coefficients))

    @classmethod
    def around(cls, points: Points, *, spacing_mm: float) -> Self:
        """The lattice points whose splines are not zero at some of (N, 3) points, mm; all coefficients zero.

        Raises
        ------
        FieldError
            The lattice would be too large.
        """
        low = (np.floor(points.min(axis=0) / spacing_mm) - 1.0) * spacing_mm
        counts = np.ceil((points.max(axis=0) - low) / spacing_mm) + 2.0
        if not counts.prod() <= MAX_LATTICE_POINTS:
            raise FieldError(
                f"a lattice of {spacing_mm:.3g} mm around points that span {np.round(np.ptp(points, axis=0), 1)} mm "
                f"would have {counts.prod():.3g} points, more than {MAX_LATTICE_POINTS:.3g}; widen the spacing"
            )
        seen = np.zeros(tuple(int(c) for c in counts), dtype=bool)
        potentials.mark_seen(low, spacing_mm, points, seen)
        numbers = np.where(seen, np.cumsum(seen.ravel(), dtype=np.int32).reshape(seen.shape) - 1, -1).astype(np.int32)
        numbers.flags.writeable = False
        return cls(low, spacing_mm, numbers, np.zeros((int(seen.sum()), 3)))


@dataclass(frozen=True, eq=False)
class SolenoidalField:
    r"""D(x) = curl sum over levels of sum_i B((x - x_i) / h) c_i, B the cubic B-spline and c_i vectors.

    Parameters
    ----------
    levels : tuple of PotentialLevel
    """

    levels: tuple[PotentialLevel, ...]

    def displacement(self, points: Points) -> Points:
        """(N, 3) displacements at (N, 3) points, mm.

        Raises
        ------
        FieldError
            Points are not in space.
        """
        where = _accepted(points)
        values = np.zeros_like(where)
        for level in self.levels:
            potentials.curl_sum(level.low, level.spacing_mm, level.numbers, level.coefficients, where, values)
        return values

    def gradient(self, points: Points) -> Gradients:
        """(N, 3, 3) derivatives; their traces are zero but for rounding."""
        return self.displacement_and_gradient(points)[1]

    def displacement_and_gradient(self, points: Points) -> tuple[Points, Gradients]:
        """Both in one pass.

        Raises
        ------
        FieldError
            Points are not in space.
        """
        where = _accepted(points)
        values, gradients = np.zeros_like(where), np.zeros((len(where), 3, 3))
        for level in self.levels:
            potentials.curl_sum_with_gradient(
                level.low, level.spacing_mm, level.numbers, level.coefficients, where, values, gradients
            )
        return values, gradients

    def scaled(self, factor: float) -> Self:
        """The field ``factor`` times as strong."""
        levels = tuple(replace(level, coefficients=factor * level.coefficients) for level in self.levels)
        return replace(self, levels=levels)

    def prepared(self) -> Self:
        """The same field without the ceilings that it found so far: what a proof finds goes with the proof."""
        return replace(self)

    def plus(self, other: Self) -> Self:
        """The sum of two fields on the same lattices.

        Raises
        ------
        FieldError
            Their lattices differ.
        """
        pairs = list(zip(self.levels, other.levels, strict=False))
        if len(self.levels) != len(other.levels) or any(a.numbers is not b.numbers for a, b in pairs):
            raise FieldError("fields on different lattices cannot be added; fit both on the same ones")
        return replace(self, levels=tuple(replace(a, coefficients=a.coefficients + b.coefficients) for a, b in pairs))

    def beside(self, other: Self) -> Self:
        """The sum of two fields, each on its own lattices."""
        return replace(self, levels=self.levels + other.levels)

    def ceilings(self, centres: Points, half_widths: Float) -> Float:
        """(B, 4) proved ceilings over boxes, of centres and half widths (B, 3) mm, that are cheap to have.

        Of the gradient's Frobenius norm, of its symmetric part's eigenvalues, of the Frobenius norm of its derivatives,
        per mm, and of the eigenvalues of its symmetric part's along any direction, per mm; 0 where the field is.

        Raises
        ------
        FieldError
            Centres are not in space.
        """
        where = _accepted(centres)
        half_widths = np.ascontiguousarray(np.broadcast_to(half_widths, where.shape), dtype=np.float64)
        found: Float = self._by_level(where, half_widths).sum(axis=0) * (1.0 + 1e-14)
        return found

    def bounds_with(
        self, gradients: Gradients, centres: Points, half_widths: Float, *, strain: bool
    ) -> tuple[Gradients, Float]:
        """Proved bounds over boxes of the gradient plus a given matrix for each box.

        Parameters
        ----------
        gradients : (B, 3, 3) float64
            The matrices.
        centres, half_widths : (B, 3) float64, mm
        strain : bool
            What is bounded: eigenvalues of the symmetric part, or the distance from the sum at the box's centre.

        Returns
        -------
        (B, 3, 3)
            The sums at the centres.
        (B, 2)
            Minus the lowest and plus the highest eigenvalue; or the proved radius in the spectral norm, and what of
            it is rounding at the centre.

        Raises
        ------
        FieldError
            A half width is negative, or centres are not in space.
        """
        where = _accepted(centres)
        half_widths = np.ascontiguousarray(np.broadcast_to(half_widths, where.shape), dtype=np.float64)
        if not (half_widths >= 0.0).all():
            raise FieldError("a box has a negative half width; give half widths of at least 0 mm")
        sums, found = np.empty((len(where), 3, 3)), np.empty((len(where), 2))
        ceilings = self._by_level(where, half_widths)[:, :, STRAIN if strain else GRADIENT] * (1.0 + 1e-14)
        counted = ceilings > (WEAK if strain else 0.0)
        # A level that does not count in a box does not cut it at its knots: its ceiling is added.
        for seen in np.unique(counted, axis=1).T:
            some = np.flatnonzero((counted == seen[:, None]).all(axis=0))
            parts, bounds = np.empty((len(some), 3, 3)), np.empty((len(some), 2))
            solenoidal_bounds.box_bounds(
                *self._lattices_of(tuple(np.flatnonzero(seen))),
                np.ascontiguousarray(gradients[some]),
                where[some],
                half_widths[some],
                np.ascontiguousarray(ceilings[seen][:, some].sum(axis=0) * (1.0 + 1e-14)),
                strain,
                parts,
                bounds,
            )
            bounds[:, : 2 if strain else 1] += ceilings[~seen][:, some].sum(axis=0)[:, None] * (1.0 + 1e-14)
            sums[some], found[some] = parts, bounds
        return sums, found

    def gradient_and_spreads(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float, Float]:
        """Gradients at the centres of boxes (B, 3, 3), and how far those of a box are from that.

        First as matrices, in every norm, then by the eigenvalues of their symmetric parts, (B,) each. Cheaper than
        ``bounds_with``, and not much wider where boxes are narrow for the lattices.

        Raises
        ------
        FieldError
            Centres are not in space.
        """
        where = _accepted(centres)
        half_widths = np.broadcast_to(half_widths, where.shape)
        reach = np.linalg.norm(half_widths, axis=1) * (1.0 + 1e-14)
        found, rounding = self.ceilings(where, half_widths), self._gradient_rounding(where)
        spreads = [
            np.where(reach > 0.0, np.minimum(2.0 * found[:, most], found[:, bend] * reach), 0.0) + rounding
            for most, bend in ((GRADIENT, BEND), (STRAIN, STRAIN_BEND))
        ]
        return self.gradient(where), spreads[0] * (1.0 + 1e-14), spreads[1] * (1.0 + 1e-14)

    def _gradient_rounding(self, points: Points) -> Float:
        """(B,) how far computed gradients may be off, in the Frobenius norm, as in `solenoidal_bounds`."""
        reach = np.abs(points).max(axis=1, initial=0.0)
        off = np.zeros(len(points))
        for level in self.levels:
            largest = float(np.abs(level.coefficients).max(initial=0.0))
            h = level.spacing_mm
            most = np.maximum(reach, float(np.abs(level.low).max()))
            off += 3.0 * solenoidal_bounds.ROUNDING * largest / (h * h) * (1.0 + 2.0 * most / h)
        return off

    def displacement_rounding(self, centres: Points) -> Float:
        """(B,) how far, in every component, computed displacements at points may be off, mm."""
        reach = np.abs(centres).max(axis=1, initial=0.0)
        off = np.zeros(len(centres))
        for level in self.levels:
            largest = float(np.abs(level.coefficients).max(initial=0.0))
            h, corner = level.spacing_mm, float(np.abs(level.low).max())
            # 64 terms of two derivatives, whose weights sum to at most 2 / h; and places, by second derivatives.
            off += 1e-13 * largest / h * (1.0 + (reach + corner) / h)
        return off

    @cached_property
    def _ceilings(self) -> tuple[Ceilings, ...]:
        return tuple(
            Ceilings.of(level.low, level.spacing_mm, numbers=level.numbers, coefficients=level.coefficients)
            for level in self.levels
        )

    def _by_level(self, centres: Points, half_widths: Float) -> Float:
        """(L, B, 4) the ceilings of each level."""
        found = np.zeros((len(self.levels), len(centres), KINDS))
        for level, own in zip(self._ceilings, found, strict=True):
            level.add_over(centres, half_widths, own)
        return found

    def _lattices_of(self, chosen: tuple[int, ...]) -> _Lattices:
        """Some levels as `solenoidal_bounds` takes them."""
        if chosen not in self._known:
            self._known[chosen] = _together([self.levels[k] for k in chosen])
        return self._known[chosen]

    @cached_property
    def _known(self) -> dict[tuple[int, ...], _Lattices]:
        return {}


def _together(levels: Sequence[PotentialLevel]) -> _Lattices:
    offsets = np.cumsum([0, *(len(level.coefficients) for level in levels)])
    numbers = [
        np.where(level.numbers < 0, -1, level.numbers + offset).ravel()
        for level, offset in zip(levels, offsets, strict=False)
    ]
    return (
        np.array([level.low for level in levels]).reshape(-1, 3),
        np.array([level.spacing_mm for level in levels], dtype=np.float64),
        np.array([level.numbers.shape for level in levels], dtype=np.int64).reshape(-1, 3),
        np.concatenate([np.zeros(0, np.int32), *numbers]).astype(np.int32),
        np.concatenate([np.zeros((0, 3)), *(level.coefficients for level in levels)]),
    )


def _accepted(points: Points) -> Points:
    if points.ndim != 2 or points.shape[1] != 3:
        raise FieldError(f"points have shape {points.shape}; this field needs (N, 3)")
    return np.ascontiguousarray(points, dtype=np.float64)
