"""Sums of radial fields: one that reaches everywhere, and compact ones of ever shorter support that refine it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Self

import numpy as np

from musclefit.fields.radial import RadialField
from musclefit.geometry.arrays import Float, Gradients, Points

ROUNDING = 1e-15
"""Of sums of bounds, in units of what is summed, for each layer."""


@dataclass(frozen=True, eq=False, slots=True)
class LayeredField:
    """D(x) = sum of the layers' displacements at x.

    Parameters
    ----------
    layers : tuple of RadialField
        At least one, of any kernels.
    """

    layers: tuple[RadialField, ...]

    def displacement(self, points: Points) -> Points:
        """(N, n) displacements at (N, n) points, mm."""
        return reduce(np.add, (layer.displacement(points) for layer in self.layers))

    def gradient(self, points: Points) -> Gradients:
        """(N, n, n) derivatives."""
        return self.displacement_and_gradient(points)[1]

    def displacement_and_gradient(self, points: Points) -> tuple[Points, Gradients]:
        """Both in one pass."""
        values, gradients = np.zeros_like(points), np.zeros((len(points), *(points.shape[1],) * 2))
        for layer in self.layers:
            more, steeper = layer.displacement_and_gradient(points)
            values += more
            gradients += steeper
        return values, gradients

    def scaled(self, factor: float) -> Self:
        """The field ``factor`` times as strong."""
        return type(self)(tuple(layer.scaled(factor) for layer in self.layers))

    def gradient_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float]:
        """Rigorous enclosure of the gradient over boxes: the layers' added; see `protocol.Field`."""
        return self._added([layer.gradient_bounds(centres, half_widths) for layer in self.layers])

    def gradient_ball_bounds(self, centres: Points, radii: Float) -> tuple[Gradients, Float]:
        """As ``gradient_bounds``, over (B,) balls."""
        return self._added([layer.gradient_ball_bounds(centres, radii) for layer in self.layers])

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Rigorous bounds of the eigenvalues of the gradient's symmetric part over boxes.

        The better of two: eigenvalues of the sum of the layers' gradients at the centre, with all radii; and the sum of
        the layers' own ranges, which knows how each is directed and not how they meet.
        """
        gradients, radii = self.gradient_bounds(centres, half_widths)
        ranges, middles = _around(gradients, radii)
        short = np.flatnonzero(~((ranges[:, 0] >= enough[0]) & (ranges[:, 1] <= enough[1])))
        if short.size:
            here, half = np.ascontiguousarray(centres[short]), np.ascontiguousarray(half_widths[short])
            own = [layer.strain_bounds(here, half, enough=(np.inf, -np.inf))[0] for layer in self.layers]
            ranges[short] = _narrower(ranges[short], self._widened(own))
        return ranges, middles

    def strain_ball_bounds(self, centres: Points, radii: Float) -> tuple[Float, Float]:
        """As ``strain_bounds``, over (B,) balls."""
        ranges, middles = _around(*self.gradient_ball_bounds(centres, radii))
        own = [layer.strain_ball_bounds(centres, radii)[0] for layer in self.layers]
        return _narrower(ranges, self._widened(own)), middles

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Rigorous enclosure of the displacement over boxes: values at the centres and radii, (B, n) each, mm."""
        found = [layer.displacement_bounds(centres, half_widths) for layer in self.layers]
        values, radii = (reduce(np.add, part) for part in zip(*found, strict=True))
        sizes = reduce(np.add, (np.abs(value) + radius for value, radius in found))
        return values, radii + ROUNDING * len(self.layers) * sizes

    def _added(self, found: list[tuple[Gradients, Float]]) -> tuple[Gradients, Float]:
        gradients, radii = (reduce(np.add, part) for part in zip(*found, strict=True))
        sizes = reduce(np.add, (np.abs(gradient).sum(axis=(1, 2)) + radius for gradient, radius in found))
        return gradients, radii + ROUNDING * len(self.layers) * sizes

    def _widened(self, own: list[Float]) -> Float:
        """The sum of ranges, wider by what summing them may round away."""
        total, sizes = reduce(np.add, own), reduce(np.add, (np.abs(one) for one in own))
        wider: Float = total + ROUNDING * len(own) * sizes * np.array([-1.0, 1.0])
        return wider


def _around(gradients: Gradients, radii: Float) -> tuple[Float, Float]:
    """Ranges of eigenvalues within radii of gradients, and those at the gradients; NaN where these are not known."""
    known = np.isfinite(gradients).all(axis=(1, 2)) & np.isfinite(radii)
    middles, ranges = np.full((len(radii), 2), np.nan), np.full((len(radii), 2), [-np.inf, np.inf])
    symmetric = 0.5 * (gradients[known] + gradients[known].transpose(0, 2, 1))
    middles[known] = np.linalg.eigvalsh(symmetric)[:, [0, -1]]
    off = radii[known] + 1e-13 * np.abs(symmetric).sum(axis=(1, 2))
    ranges[known] = middles[known] + np.stack([-off, off], axis=1)
    return ranges, middles


def _narrower(a: Float, b: Float) -> Float:
    """What two proved ranges (B, 2) of the same eigenvalues prove together; NaN proves nothing."""
    both: Float = np.stack([np.fmax(a[:, 0], b[:, 0]), np.fmin(a[:, 1], b[:, 1])], axis=1)
    return both
