"""Free-form deformation: displacement fields that are sums of cubic B-splines on lattices, with an affine part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from musclefit.errors import FieldError
from musclefit.fields.enclosures.ffd import box_bounds, steepest_cells
from musclefit.fields.evaluation import bsplines
from musclefit.geometry.arrays import Float, Gradients, Int, Points, frozen

SUBDIVISION = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 8.0
"""Weights that turn coefficients into those of the same spline with half the spacing."""

NO_WIDE_BOXES = (np.zeros(0), np.zeros((0, 3)), np.zeros(0, dtype=np.int64), np.zeros(0))
"""In place of what wide boxes are bounded by, where there are only points."""


@dataclass(frozen=True, eq=False, slots=True)
class Lattice:
    """Points on an axis-aligned grid: where the control points of a free-form deformation rest.

    Parameters
    ----------
    low : (n,) float64, mm
        The first lattice point.
    spacing : (n,) float64, mm
        Distance of neighbours along each axis.
    shape : tuple of n int
        Lattice points along each axis, at least 1.

    Raises
    ------
    FieldError
        A lattice that is neither of the plane nor of space, is empty, or has a spacing that is not positive.
    """

    low: Float
    spacing: Float
    shape: tuple[int, ...]

    def __post_init__(self) -> None:
        low, spacing = frozen(self.low), frozen(self.spacing)
        n = len(self.shape)
        if n not in (2, 3) or low.shape != (n,) or spacing.shape != (n,):
            raise FieldError(
                f"a lattice of shape {self.shape} has a corner of shape {low.shape} and spacings of shape "
                f"{spacing.shape}; give 2 or 3 of each"
            )
        if min(self.shape) < 1 or not (spacing > 0.0).all() or not np.isfinite([*low, *spacing]).all():
            raise FieldError(
                f"a lattice has shape {self.shape}, corner {low.tolist()} mm and spacing {spacing.tolist()} mm; every "
                "axis needs at least one point and a positive, finite spacing"
            )
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "spacing", spacing)

    @classmethod
    def around(cls, low: Float, high: Float, *, shape: tuple[int, ...]) -> Self:
        """The lattice of a shape whose outermost points lie on a box's faces; every axis needs two points or more.

        Raises
        ------
        FieldError
            An axis has fewer than two points, or no width.
        """
        if min(shape) < 2:
            raise FieldError(f"a lattice of shape {shape} cannot span a box; give at least 2 points along every axis")
        return cls(low, (np.asarray(high) - low) / (np.array(shape) - 1.0), shape)

    @property
    def dimension(self) -> int:
        """2 in the plane, 3 in space."""
        return len(self.shape)

    def control_points(self) -> Points:
        """(K, n) lattice points, mm; the last axis runs fastest."""
        grid = np.indices(self.shape).reshape(self.dimension, -1).T
        return np.asarray(self.low + self.spacing * grid, dtype=np.float64)

    def field(self, displacements: Points) -> FfdField:
        """The free-form deformation that moves the control points by (K, n) displacements, mm.

        A control point draws the space around it; it is not met by the map. Beyond the lattice the field fades to zero
        within two cells, twice continuously differentiable.

        Raises
        ------
        FieldError
            There is not one displacement for each control point.
        """
        if displacements.shape != (int(np.prod(self.shape)), self.dimension):
            raise FieldError(
                f"a lattice of shape {self.shape} has displacements of shape {displacements.shape}; give "
                f"({int(np.prod(self.shape))}, {self.dimension}), one for each control point"
            )
        n = self.dimension
        level = SplineLevel(self, displacements.reshape(*self.shape, n))
        return FfdField((level,), np.zeros(n), np.zeros((n, n)), np.zeros(n))


@dataclass(frozen=True, eq=False, slots=True)
class SplineLevel:
    """One lattice with its coefficients, an array of the lattice's shape and n more, mm."""

    lattice: Lattice
    coefficients: Float

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", frozen(self.coefficients))

    def subdivided(self) -> SplineLevel:
        """The same spline on a lattice of half the spacing (knot insertion)."""
        values = self.coefficients
        for axis in range(self.lattice.dimension):
            values = _subdivide(values, axis)
        # Point i of the old lattice is point 2 i + 2 of the new one.
        spacing = 0.5 * self.lattice.spacing
        return SplineLevel(Lattice(self.lattice.low - 2.0 * spacing, spacing, values.shape[:-1]), values)

    def in_space(self) -> tuple[Float, Float, Float]:
        """Corner, spacing and coefficients as the loops take them: with a third axis, of one layer in the plane."""
        missing = 3 - self.lattice.dimension
        low = np.concatenate([self.lattice.low, np.zeros(missing)])
        spacing = np.concatenate([self.lattice.spacing, np.ones(missing)])
        shape = (*self.lattice.shape, *(1,) * missing, self.lattice.dimension)
        return low, spacing, self.coefficients.reshape(shape)


@dataclass(frozen=True, eq=False, slots=True)
class FfdField:
    r"""D(x) = t + L (x - o) + sum over levels of sum_i B((x - x_i) / h) c_i, B the cubic B-spline (Eq. 7 of the paper).

    Defined and twice continuously differentiable in all of space: beyond their lattices the splines fade to zero
    within two cells, and the affine part is left.

    Parameters
    ----------
    levels : tuple of SplineLevel
    origin : (n,) float64, mm
    linear : (n, n) float64
    translation : (n,) float64, mm

    References
    ----------
    X. Yu et al., "Foldover-free shape deformation for biomedicine", J. Biomed. Inform. 48 (2014), section 4.3.
    S. Lee et al., "Image metamorphosis with multilevel free-form deformations", Comput. Graph. Forum 15 (1996).
    """

    levels: tuple[SplineLevel, ...]
    origin: Float
    linear: Float
    translation: Float

    def __post_init__(self) -> None:
        for name in ("origin", "linear", "translation"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def displacement(self, points: Points) -> Points:
        """(N, n) displacements at (N, n) points, mm."""
        where = self._accepted(points)
        values = self._affine(where)
        for level in self.levels:
            bsplines.spline_sum(*level.in_space(), where, values)
        return values

    def gradient(self, points: Points) -> Gradients:
        """(N, n, n) derivatives."""
        return self.displacement_and_gradient(points)[1]

    def displacement_and_gradient(self, points: Points) -> tuple[Points, Gradients]:
        """Both in one pass."""
        where = self._accepted(points)
        values = self._affine(where)
        gradients: Gradients = np.broadcast_to(self.linear, (len(where), *self.linear.shape)).copy()
        for level in self.levels:
            bsplines.spline_sum_with_gradient(*level.in_space(), where, values, gradients)
        return values, gradients

    def gradient_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float]:
        """Rigorous enclosure of the gradient over boxes: see `protocol.Field` and `ffd_bounds`."""
        gradients, found = self.bounds_with(self.linear[None], centres, half_widths, strain=False)
        return gradients, found[:, 0]

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Rigorous bounds of the eigenvalues of the gradient's symmetric part over boxes.

        Parameters
        ----------
        centres, half_widths : (B, n) float64, mm
        enough : (float, float)
            Not used: the bounds are as tight as they get at once.

        Returns
        -------
        (B, 2), (B, 2) float64
            Every eigenvalue anywhere in box b is within the first; the second is about the range at the box's centre
            and proves nothing.
        """
        del enough
        gradients, found = self.bounds_with(self.linear[None], centres, half_widths, strain=True)
        middles = np.linalg.eigvalsh(0.5 * (gradients + gradients.transpose(0, 2, 1)))[:, [0, -1]]
        return np.stack([-found[:, 0], found[:, 1]], axis=1), np.asarray(middles, dtype=np.float64)

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Rigorous enclosure of the displacement over boxes: values at the centres and radii, (B, n) each, mm.

        For every x in box b, each component i of the displacement is within ``radii[b, i]`` of ``values[b, i]``.
        """
        where = self._accepted(centres)
        values, slopes = self._affine(where), np.abs(self.linear)
        for level in self.levels:
            bsplines.spline_sum(*level.in_space(), where, values)
            # The splines' absolute slopes sum to at most 1.5 per cell, the splines themselves to 1.
            slopes = slopes + 2.0 * np.abs(level.coefficients).max(initial=0.0) / level.lattice.spacing
        sizes = [float(np.abs(level.coefficients).max(initial=0.0)) for level in self.levels]
        corners = [float(np.abs(level.lattice.low).max()) for level in self.levels]
        # Rounding: of places, carried by the gradient; of 64 positive weights that sum to 1; of the affine part.
        reach = np.abs(centres) + half_widths + max([float(np.abs(self.origin).max()), *corners])
        affine = np.abs(self.translation) + reach @ np.abs(self.linear).T
        radii = 4e-15 * np.einsum("ik,bk->bi", slopes, reach) + 4e-14 * sum(sizes) + 4e-15 * affine
        if half_widths.any():
            gradients, found = self.bounds_with(self.linear[None], centres, half_widths, strain=False)
            radii += np.einsum("bik,bk->bi", np.abs(gradients) + found[:, :1, None], half_widths) * (1.0 + 1e-14)
        return values, np.asarray(radii, dtype=np.float64)

    def scaled(self, factor: float) -> Self:
        """The field ``factor`` times as strong."""
        return replace(
            self,
            levels=tuple(replace(level, coefficients=factor * level.coefficients) for level in self.levels),
            linear=factor * self.linear,
            translation=factor * self.translation,
        )

    def bounds_with(
        self, linears: Gradients, centres: Points, half_widths: Float, *, strain: bool
    ) -> tuple[Gradients, Float]:
        """Bounds over boxes of the splines and an affine part in place of the field's own: see `ffd_bounds.box_bounds`.

        Parameters
        ----------
        linears : (1 or B, n, n) float64
            The gradient of the affine part, for all boxes or for each.
        centres, half_widths : (B, n) float64, mm
        strain : bool

        Returns
        -------
        (B, n, n), (B, 2) float64
            Gradients at the centres; and how far they get from these and rounding, or for strain minus the lowest and
            plus the highest eigenvalue.

        Raises
        ------
        FieldError
            A half width is negative, or boxes are not of the field's dimension.
        """
        where = self._accepted(centres)
        half_widths = np.ascontiguousarray(np.broadcast_to(half_widths, where.shape), dtype=np.float64)
        if not (half_widths >= 0.0).all():
            raise FieldError("a box has a negative half width; give half widths of at least 0 mm")
        gradients, found = np.zeros((len(where), *self.linear.shape)), np.zeros((len(where), 2))
        coarse = self._coarse() if half_widths.any() else NO_WIDE_BOXES
        matrices = np.array(linears, order="C")
        box_bounds(self._lattices(), coarse, matrices, where, half_widths, strain, gradients, found)
        return gradients, found

    def _coarse(self) -> tuple[Float, Float, Int, Float]:
        """What `ffd_bounds.box_bounds` bounds wide boxes by."""
        parts = [level.in_space() for level in self.levels]
        levels = [steepest_cells(coefficients, spacing) for _, spacing, coefficients in parts]
        return (
            np.concatenate([np.zeros(0), *(squares.ravel() for squares in levels)]),
            np.array([squares.max(axis=(1, 2, 3)) for squares in levels]).reshape(-1, 3),
            np.cumsum([0, *(squares.size for squares in levels)], dtype=np.int64)[:-1],
            np.array([np.abs(level.coefficients).max(initial=0.0) for level in self.levels]).reshape(-1),
        )

    def _lattices(self) -> tuple[Float, Float, Int, Int, Float]:
        """All levels as `ffd_bounds.box_bounds` takes them."""
        parts = [level.in_space() for level in self.levels]
        sizes = [0, *(coefficients.size for _, _, coefficients in parts)]
        return (
            np.array([low for low, _, _ in parts]).reshape(-1, 3),
            np.array([spacing for _, spacing, _ in parts]).reshape(-1, 3),
            np.array([coefficients.shape[:3] for _, _, coefficients in parts], dtype=np.int64).reshape(-1, 3),
            np.cumsum(sizes, dtype=np.int64)[:-1],
            np.concatenate([np.zeros(0), *(coefficients.ravel() for _, _, coefficients in parts)]),
        )

    def _affine(self, points: Points) -> Points:
        moved: Points = self.translation + np.einsum("pk,ik->pi", points - self.origin, self.linear)
        return moved

    def _accepted(self, points: Points) -> Points:
        n = len(self.origin)
        if points.ndim != 2 or points.shape[1] != n:
            raise FieldError(f"points have shape {points.shape}; this field needs (N, {n})")
        return np.ascontiguousarray(points, dtype=np.float64)


def _subdivide(values: Float, axis: int) -> Float:
    """Coefficients for half the spacing along one axis; two more on each side than lie on the old extent."""
    old = np.moveaxis(values, axis, 0)
    new = np.zeros((2 * len(old) + 3, *old.shape[1:]))
    for shift, weight in enumerate(SUBDIVISION):
        new[shift : shift + 2 * len(old) - 1 : 2] += weight * old
    return np.moveaxis(new, 0, axis)
