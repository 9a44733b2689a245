"""Sums of radial fields: one that reaches everywhere, and compact ones of ever shorter support that refine it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import reduce
from typing import Self

import numpy as np

from musclefit.fields.enclosures.cell_slopes import CellSlopes
from musclefit.fields.kernels import kernel_named
from musclefit.fields.radial import RadialField, parted
from musclefit.geometry.arrays import Float, Gradients, Int, Points

ROUNDING = 1e-15
"""Of sums of bounds, in units of what is summed, for each layer."""

NARROW = 8.0
"""A layer is enclosed by itself where its support is wider than this many half diagonals of a box, and by the slopes of
cells where it is not."""


@dataclass(frozen=True, eq=False, slots=True)
class LayeredField:
    """D(x) = sum of the layers' displacements at x.

    Parameters
    ----------
    layers : tuple of RadialField
        At least one, of any kernels.
    slopes : CellSlopes or None
        Of the compact layers after the last one that is not compact; None where they are not `prepared`.
    """

    layers: tuple[RadialField, ...]
    slopes: CellSlopes | None = None

    def prepared(self) -> Self:
        """The same field, whose bounds over wide boxes know the slopes of its compact layers, found anew from these."""
        compact = self.layers[self._reaching :]
        return replace(self, slopes=CellSlopes.of(compact) if compact else None)

    @property
    def _reaching(self) -> int:
        """How many layers there are up to the last one that is not compact."""
        return max((k + 1 for k, layer in enumerate(self.layers) if not kernel_named(layer.kernel).compact), default=0)

    def displacement(self, points: Points) -> Points:
        """(N, n) displacements at (N, n) points, mm."""
        return reduce(np.add, (layer.displacement(points) for layer in self.layers))

    def gradient(self, points: Points) -> Gradients:
        """(N, n, n) derivatives."""
        return self.displacement_and_gradient(points)[1]

    def displacement_and_gradient(self, points: Points) -> tuple[Points, Gradients]:
        """Both in one pass."""
        sums = np.zeros((len(points), 12))
        for layer in self.layers:
            layer.add_to(sums, points)
        return parted(sums, points.shape[1])

    def scaled(self, factor: float) -> Self:
        """The field ``factor`` times as strong."""
        return type(self)(tuple(layer.scaled(factor) for layer in self.layers))

    def gradient_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float]:
        """Rigorous enclosure of the gradient over boxes: the layers' added; see `protocol.Field`."""
        gradients, radii = np.empty((*centres.shape, centres.shape[1])), np.empty(len(centres))
        for rows, layers, slope in self._enclosed(centres, half_widths, np.linalg.norm(half_widths, axis=1)):
            here, half = np.ascontiguousarray(centres[rows]), np.ascontiguousarray(half_widths[rows])
            gradients[rows], spread = _added([layer.gradient_bounds(here, half) for layer in layers])
            radii[rows] = spread + slope
        return gradients, radii

    def gradient_ball_bounds(self, centres: Points, radii: Float) -> tuple[Gradients, Float]:
        """As ``gradient_bounds``, over (B,) balls."""
        gradients, off = np.empty((*centres.shape, centres.shape[1])), np.empty(len(centres))
        cubes = np.repeat(radii[:, None], centres.shape[1], axis=1)
        for rows, layers, slope in self._enclosed(centres, cubes, radii):
            here, reach = np.ascontiguousarray(centres[rows]), np.ascontiguousarray(radii[rows])
            gradients[rows], spread = _added([layer.gradient_ball_bounds(here, reach) for layer in layers])
            off[rows] = spread + slope
        return gradients, off

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Rigorous bounds of the eigenvalues of the gradient's symmetric part over boxes.

        The better of two: eigenvalues of the sum of the layers' gradients at the centre, with all radii; and the sum of
        the layers' own ranges, which knows how each is directed and not how they meet.
        """
        ranges, middles = np.empty((len(centres), 2)), np.empty((len(centres), 2))
        for rows, layers, slope in self._enclosed(centres, half_widths, np.linalg.norm(half_widths, axis=1)):
            here, half = np.ascontiguousarray(centres[rows]), np.ascontiguousarray(half_widths[rows])
            gradients, radii = _added([layer.gradient_bounds(here, half) for layer in layers])
            found, middles[rows] = _around(gradients, radii + slope)
            short = np.flatnonzero(~((found[:, 0] >= enough[0]) & (found[:, 1] <= enough[1])))
            if short.size:
                at, wide = np.ascontiguousarray(here[short]), np.ascontiguousarray(half[short])
                own = [layer.strain_bounds(at, wide, enough=(np.inf, -np.inf))[0] for layer in layers]
                found[short] = _narrower(found[short], _widened(own, slope[short]))
            ranges[rows] = found
            if len(layers) < len(self.layers):
                middles[rows] = self._sampled(here, gradients, layers)
        return ranges, middles

    def strain_ball_bounds(self, centres: Points, radii: Float) -> tuple[Float, Float]:
        """As ``strain_bounds``, over (B,) balls."""
        ranges, middles = np.empty((len(centres), 2)), np.empty((len(centres), 2))
        cubes = np.repeat(radii[:, None], centres.shape[1], axis=1)
        for rows, layers, slope in self._enclosed(centres, cubes, radii):
            here, reach = np.ascontiguousarray(centres[rows]), np.ascontiguousarray(radii[rows])
            own = [layer.ball_bounds(here, reach) for layer in layers]
            gradients, off = _added([(one.gradients, one.radii) for one in own])
            found, middles[rows] = _around(gradients, off + slope)
            ranges[rows] = _narrower(found, _widened([one.ranges for one in own], slope))
            if len(layers) < len(self.layers):
                middles[rows] = self._sampled(here, gradients, layers)
        return ranges, middles

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Rigorous enclosure of the displacement over boxes: values at the centres and radii, (B, n) each, mm."""
        found = [layer.displacement_bounds(centres, half_widths) for layer in self.layers]
        values, radii = (reduce(np.add, part) for part in zip(*found, strict=True))
        sizes = reduce(np.add, (np.abs(value) + radius for value, radius in found))
        return values, radii + ROUNDING * len(self.layers) * sizes

    def _enclosed(
        self, centres: Points, half_widths: Float, reach: Float
    ) -> Iterator[tuple[Int, tuple[RadialField, ...], Float]]:
        """Boxes by the layers that are enclosed one by one over them, and a bound of the gradient of all others.

        ``reach`` (B,) is how far a place of a box is from its centre.
        """
        if self.slopes is None:
            yield np.arange(len(centres)), self.layers, np.zeros(len(centres))
            return
        start = self._reaching
        supports = np.array([*(layer.scale for layer in self.layers[start:]), -np.inf])
        first = np.argmax(~(supports > NARROW * reach[:, None]), axis=1)
        first = np.maximum(first, 1 - start)  # at least one layer
        for number in np.unique(first):
            rows = np.flatnonzero(first == number)
            yield rows, self.layers[: start + number], self.slopes.over(centres[rows], half_widths[rows], first[rows])

    def _sampled(self, points: Points, gradients: Gradients, layers: tuple[RadialField, ...]) -> Float:
        """About the range of the strain's eigenvalues at points, from the gradients there of the first layers alone."""
        others = LayeredField(self.layers[len(layers) :])
        return _around(gradients + others.gradient(points), np.zeros(len(points)))[1]


def _added(found: list[tuple[Gradients, Float]]) -> tuple[Gradients, Float]:
    """The sum of enclosures, wider by what summing them may round away."""
    gradients, radii = (reduce(np.add, part) for part in zip(*found, strict=True))
    sizes = reduce(np.add, (np.abs(gradient).sum(axis=(1, 2)) + radius for gradient, radius in found))
    return gradients, radii + ROUNDING * len(found) * sizes


def _widened(own: list[Float], slope: Float) -> Float:
    """The sum of ranges, wider by a bound of what is not among them and by what summing may round away."""
    total, sizes = reduce(np.add, own), reduce(np.add, (np.abs(one) for one in own))
    off = slope[:, None] + ROUNDING * (len(own) + 1) * (sizes + slope[:, None])
    wider: Float = total + off * np.array([-1.0, 1.0])
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
