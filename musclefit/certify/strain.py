"""Proved ranges of a field's strain over boxes, and what a step of each kind asks of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from musclefit.fields.protocol import Field
from musclefit.geometry.arrays import Float, Gradients, Points
from musclefit.vocabulary import StepKind

LARGEST = 1e150
"""Gradients with larger entries are beyond what is computed with."""


@runtime_checkable
class StrainBounded(Protocol):
    """A field that bounds its strain itself, tighter than its gradient's enclosure does."""

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Proved eigenvalue ranges over boxes and about those at their centres, (B, 2) each."""
        ...


@runtime_checkable
class BallBounded(Protocol):
    """A field that bounds its strain and gradient over balls, tighter than over the cubes around them."""

    def gradient_ball_bounds(self, centres: Points, radii: Float) -> tuple[Gradients, Float]:
        """Enclosures over (B,) balls: matrices (B, n, n) and radii (B,) in the spectral norm."""
        ...

    def strain_ball_bounds(self, centres: Points, radii: Float) -> tuple[Float, Float]:
        """Proved eigenvalue ranges over balls and about those at their centres, (B, 2) each."""
        ...


@dataclass(frozen=True, slots=True)
class Condition:
    """Every eigenvalue of the strain lies above ``-low`` and below ``high``: what makes a step one-to-one.

    Explicit steps U = id + D: above -1, so that U is strictly monotone. Cayley steps: within (-2, 2), so that both id +
    D/2 and id - D/2 are.
    """

    low: float
    high: float

    @classmethod
    def of(cls, kind: StepKind) -> Condition:
        """The condition of a kind of step."""
        return cls(2.0, 2.0) if kind is StepKind.CAYLEY else cls(1.0, np.inf)

    def margins(self, ranges: Float) -> Float:
        """(B,) how far (B, 2) ranges stay from the limit: 1 without strain, 0 at the limit; NaN counts as beyond."""
        worst = np.minimum(1.0 + ranges[:, 0] / self.low, 1.0 - ranges[:, 1] / self.high)
        margins: Float = np.asarray(np.where(np.isnan(worst), -np.inf, worst), dtype=np.float64)
        return margins

    def enough(self, margin: float) -> tuple[float, float]:
        """The range that leaves a margin."""
        return self.low * (margin - 1.0), self.high * (1.0 - margin) if self.high < np.inf else np.inf


def strain_ranges(
    field: Field, centres: Points, half_widths: Float, *, enough: tuple[float, float]
) -> tuple[Float, Float]:
    """Proved eigenvalue ranges of the strain over boxes, and about those at their centres; (B, 2) each."""
    if isinstance(field, StrainBounded):
        return field.strain_bounds(centres, half_widths, enough=enough)
    gradients, radii = field.gradient_bounds(centres, half_widths)
    middles = symmetric_eigenvalues(gradients)[:, [0, -1]]
    spread = (radii + eigenvalue_rounding(gradients))[:, None]
    return np.concatenate([middles[:, :1] - spread, middles[:, 1:] + spread], axis=1), middles


def strain_ball_ranges(field: Field, centres: Points, radii: Float) -> Float:
    """Proved eigenvalue ranges (B, 2) of the strain over balls."""
    if isinstance(field, BallBounded):
        return field.strain_ball_bounds(centres, radii)[0]
    return strain_ranges(field, centres, cubes(radii, centres.shape[1]), enough=(np.inf, -np.inf))[0]


def gradient_ball_bounds(field: Field, centres: Points, radii: Float) -> tuple[Gradients, Float]:
    """Enclosures of the gradient over balls: matrices (B, n, n) and radii (B,)."""
    if isinstance(field, BallBounded):
        return field.gradient_ball_bounds(centres, radii)
    return field.gradient_bounds(centres, cubes(radii, centres.shape[1]))


def cubes(radii: Float, n: int) -> Float:
    """(B, n) half widths of the cubes around balls."""
    return np.repeat(radii[:, None], n, axis=1)


def symmetric_eigenvalues(gradients: Gradients) -> Float:
    """(B, n) eigenvalues of the symmetric parts, ascending, as LAPACK computes them; NaN where entries are not numbers.

    Entries beyond 1e150, whose squares are not numbers, count as those.
    """
    symmetric = 0.5 * (gradients + gradients.transpose(0, 2, 1))
    known = np.abs(symmetric).max(axis=(1, 2), initial=0.0) < LARGEST
    if known.all():
        return np.asarray(np.linalg.eigvalsh(symmetric), dtype=np.float64)
    values = np.full(symmetric.shape[:2], np.nan)
    values[known] = np.linalg.eigvalsh(symmetric[known])
    return values


def eigenvalue_rounding(gradients: Gradients) -> Float:
    """(B,) how far computed eigenvalues can be off: LAPACK's solver is backward stable, with room to spare."""
    size: Float = np.asarray(np.abs(gradients).sum(axis=(1, 2)), dtype=np.float64)
    return 1e-13 * size + 1e-280
