"""What every displacement field can do, and what every backend promises."""

from __future__ import annotations

from typing import Protocol, Self, runtime_checkable

from musclefit.geometry.arrays import Float, Gradients, Points


class Field(Protocol):
    """A displacement field of space, in mm."""

    def displacement(self, points: Points) -> Points:
        """(N, n) displacements at (N, n) points, mm."""
        ...

    def gradient(self, points: Points) -> Gradients:
        """(N, n, n) derivatives: entry [p, i, k] is d D_i / d x_k."""
        ...

    def displacement_and_gradient(self, points: Points) -> tuple[Points, Gradients]:
        """Both in one pass, which costs little more than either."""
        ...

    def gradient_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float]:
        """Rigorous enclosure of the gradient over axis-aligned boxes.

        Parameters
        ----------
        centres : (B, n) float64, mm
        half_widths : (B, n) float64, mm, not negative

        Returns
        -------
        centre_gradients : (B, n, n)
        radii : (B,)
            For every x in box b, the spectral norm of gradient(x) - centre_gradients[b] is at most radii[b].
        """
        ...

    def scaled(self, factor: float) -> Self:
        """The field ``factor`` times as strong."""
        ...


@runtime_checkable
class Preparing(Protocol):
    """A field that looks at itself once before it bounds anything, so that its bounds are tighter or cheaper."""

    def prepared(self) -> Field:
        """The same field; what it knows of itself is found anew, whatever it was given."""
        ...


def prepared(field: Field) -> Field:
    """The field, ready to be bounded over many boxes."""
    return field.prepared() if isinstance(field, Preparing) else field


class Backend(Protocol):
    """Fits one field to handle displacements; RBF and FFD are equals here."""

    def fit(self, at: Points, displacements: Points) -> Field:
        """The field that takes the given (m, n) displacements at the (m, n) handles."""
        ...
