"""Displacement fields that are radial sums with a polynomial part: scalar kernels and isochoric ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from scipy.spatial import cKDTree

from musclefit.errors import FieldError
from musclefit.fields.enclosures import radial as enclosures
from musclefit.fields.evaluation.lane_sums import LaneSums, lane_sums
from musclefit.fields.evaluation.neighbours import Cells
from musclefit.fields.evaluation.radial_sums import TINY, RadialSums, radial_sums
from musclefit.fields.fitting.saddle import SaddleFactor
from musclefit.fields.kernels import RadialKernel, kernel_named
from musclefit.geometry.arrays import Float, Gradients, Points, frozen

CONE = "r"
"""The kernel whose gradient jumps at its centres."""


@dataclass(frozen=True, eq=False)
class RadialField:
    r"""D(x) = t + L (x - o) + sum_j K(x - c_j) w_j (Eq. 1 of the paper, for any kernel).

    Parameters
    ----------
    kernel : str
        A name of `musclefit.fields.kernels.KERNELS`.
    scale : float, mm
        The kernel's own length, where it has one.
    centres : (m, n) float64, mm
    weights : (m, n) float64
    origin : (n,) float64, mm
    linear : (n, n) float64
    translation : (n,) float64, mm
    polynomial_rank, polynomial_terms : int
        How many of the polynomial part's terms the handles span, and how many it has; equal when they span space.

    References
    ----------
    X. Yu et al., "Foldover-free shape deformation for biomedicine", J. Biomed. Inform. 48 (2014), Eq. 1, (A1)-(A3).
    """

    kernel: str
    scale: float
    centres: Points
    weights: Points
    origin: Float
    linear: Float
    translation: Float
    polynomial_rank: int
    polynomial_terms: int

    def __post_init__(self) -> None:
        for name in ("centres", "weights", "origin", "linear", "translation"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def displacement(self, points: Points) -> Points:
        """(N, n) displacements at (N, n) points, mm."""
        n = self._dimension_of(points)
        lanes = _lane_sums(kernel_named(self.kernel))
        if lanes is not None:
            values = np.empty((len(points), 3))
            lanes.values(*self._sum_in_lanes(points), values)
            return np.ascontiguousarray(values[:, :n])
        where = self._local(points)
        values = np.zeros_like(where)
        _sums(kernel_named(self.kernel)).values(*self._sum_of(where), values)
        return self._polynomial(points) + values[:, :n] if self._has_polynomial else np.ascontiguousarray(values[:, :n])

    def gradient(self, points: Points) -> Gradients:
        """(N, n, n) derivatives; at a centre of a kernel without gradient there, its one-sided mean."""
        return self.displacement_and_gradient(points)[1]

    def displacement_and_gradient(self, points: Points) -> tuple[Points, Gradients]:
        """Both in one pass."""
        n = self._dimension_of(points)
        lanes = _lane_sums(kernel_named(self.kernel))
        if lanes is not None:
            values, gradients = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
            lanes.gradients(*self._sum_in_lanes(points), values, gradients)
            return np.ascontiguousarray(values[:, :n]), np.ascontiguousarray(gradients[:, :n, :n])
        sums = np.zeros((len(points), 12))
        self.add_to(sums, points)
        return parted(sums, n)

    def add_to(self, sums: Float, points: Points) -> None:
        """Add displacements and derivatives at (N, n) points to (N, 12): three, then nine row by row, as in space."""
        n, gradients = self._dimension_of(points), sums[:, 3:].reshape(-1, 3, 3)
        if _lane_sums(kernel_named(self.kernel)) is not None:
            values, derivatives = self.displacement_and_gradient(points)
            sums[:, :n] += values
            gradients[:, :n, :n] += derivatives
            return
        _sums(kernel_named(self.kernel)).gradients(*self._sum_of(self._local(points)), sums)
        if self._has_polynomial:
            sums[:, :n] += self._polynomial(points)
            gradients[:, :n, :n] += self.linear

    def scaled(self, factor: float) -> Self:
        """The field ``factor`` times as strong."""
        return replace(
            self,
            weights=factor * self.weights,
            linear=factor * self.linear,
            translation=factor * self.translation,
        )

    def plus(self, other: Self) -> Self:
        """The sum of two fields of one kernel and scale.

        Raises
        ------
        FieldError
            Their kernels or scales differ.
        """
        if (self.kernel, self.scale) != (other.kernel, other.scale):
            raise FieldError(
                f"a field of kernel {self.kernel!r} and scale {self.scale} mm cannot be added to one of "
                f"{other.kernel!r} and {other.scale} mm; both must have the same"
            )
        return replace(
            self,
            centres=np.concatenate([self.centres, other.centres]),
            weights=np.concatenate([self.weights, other.weights]),
            linear=self.linear + other.linear,
            translation=self.translation + other.translation + other.linear @ (self.origin - other.origin),
        )

    def gradient_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float]:
        """Rigorous enclosure of the gradient over boxes: (B, n, n) and radii (B,); see `protocol.Field`."""
        return enclosures.gradient_bounds(self, centres, half_widths, balls=enclosures.endless(centres))

    @property
    def jumps(self) -> Points:
        """(J, n) places at which the gradient jumps, mm: the centres of the kernel r, none of the others."""
        return self.centres if self.kernel == CONE and len(self.centres) > 1 else self.centres[:0]

    def jump_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float, Points]:
        """As ``gradient_bounds``, of all terms but that of the nearest centre, whose gradient is w v^T, |v| = 1.

        Returns
        -------
        (B, n, n), (B,), (B, n) float64
            Gradients at centres of boxes and radii, and w; of the kernel r with at least two centres only.

        Raises
        ------
        FieldError
            The kernel's gradient does not jump.
        """
        if self.kernel != CONE or len(self.centres) < 2:
            raise FieldError(f"the gradient of kernel {self.kernel!r} has no jump to be told apart from other terms")
        n = self._dimension_of(centres)
        nearest = cKDTree(self.centres).query(centres)[1]
        gradients, radii = np.empty((len(centres), n, n)), np.empty(len(centres))
        for number in np.unique(nearest):
            others = replace(
                self,
                centres=np.delete(self.centres, number, axis=0),
                weights=np.delete(self.weights, number, axis=0),
            )
            rows = np.flatnonzero(nearest == number)
            gradients[rows], radii[rows] = others.gradient_bounds(centres[rows], half_widths[rows])
        return gradients, radii, -self.weights[nearest]

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Rigorous bounds of the eigenvalues of the gradient's symmetric part over boxes.

        Parameters
        ----------
        centres, half_widths : (B, n) float64, mm
        enough : (float, float)
            Bounds at least as good as this need not be tightened: a lower one from ``enough[0]`` up, an upper one from
            ``enough[1]`` down.

        Returns
        -------
        (B, 2), (B, 2) float64
            Every eigenvalue anywhere in box b is within the first; the second is about the range at the box's centre,
            NaN where centres of the sum are too near for the box to tell, and proves nothing.
        """
        balls = enclosures.endless(centres)
        return enclosures.strain_bounds(self, centres, half_widths, balls=balls, enough=enough)

    def gradient_ball_bounds(self, centres: Points, radii: Float) -> tuple[Gradients, Float]:
        """As ``gradient_bounds``, over (B,) balls: tighter than over the cubes around them."""
        half_widths = enclosures.cubes(radii, centres.shape[1])
        return enclosures.gradient_bounds(self, centres, half_widths, balls=radii)

    def strain_ball_bounds(self, centres: Points, radii: Float) -> tuple[Float, Float]:
        """As ``strain_bounds``, over (B,) balls: tighter than over the cubes around them."""
        found = self.ball_bounds(centres, radii)
        return found.ranges, found.middles

    def ball_bounds(self, centres: Points, radii: Float) -> enclosures.GradientAndStrain:
        """``gradient_ball_bounds`` and ``strain_ball_bounds`` in one pass."""
        half_widths, enough = enclosures.cubes(radii, centres.shape[1]), (np.inf, -np.inf)
        return enclosures.gradient_and_strain_bounds(self, centres, half_widths, balls=radii, enough=enough)

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Rigorous enclosure of the displacement over boxes: values at the centres and radii, (B, n) each, mm.

        For every x in box b, each component i of the displacement is within ``radii[b, i]`` of ``values[b, i]``.
        """
        return enclosures.displacement_bounds(self, centres, half_widths)

    @cached_property
    def _sources(self) -> tuple[Float, Float, Cells]:
        """Centres local to the origin and weights, (3, m) in the order of the cells beside them."""
        local = _in_space(self.centres - self.origin)
        compact = kernel_named(self.kernel).compact and len(local)
        cells = Cells.of(local, width=self.scale) if compact else Cells.single(len(local))
        weights = _in_space(self.weights)
        return np.ascontiguousarray(local[cells.order].T), np.ascontiguousarray(weights[cells.order].T), cells

    @property
    def _has_polynomial(self) -> bool:
        return bool(self.linear.any() or self.translation.any())

    def _polynomial(self, points: Points) -> Points:
        moved: Points = self.translation + (points - self.origin) @ self.linear.T
        return moved

    def _sum_of(self, where: Points) -> tuple[Any, ...]:
        """The arguments of a loop over points already local to the origin."""
        local, weights, cells = self._sources
        return self.scale, where, local, weights, cells.low, cells.width, cells.counts, cells.starts

    def _sum_in_lanes(self, points: Points) -> tuple[Any, ...]:
        """The arguments of a loop in lanes."""
        kernel = kernel_named(self.kernel)
        n = len(self.origin)
        affine = np.zeros((4, 3))
        affine[0, :n], affine[1 : n + 1, :n] = self.translation, self.linear
        weights = _in_space(self.weights)
        sources = np.hstack([_in_space(self.centres - self.origin), weights, 3.0 * weights])
        soft = self.scale**2 if kernel.scaled else TINY
        where = np.ascontiguousarray(_in_space(points), dtype=np.float64)
        return soft, where, _in_space(self.origin[None])[0], affine, sources

    def _local(self, points: Points) -> Points:
        return np.ascontiguousarray(_in_space(points - self.origin))

    def _dimension_of(self, points: Points) -> int:
        if points.ndim != 2 or points.shape[1] != self.centres.shape[1]:
            raise FieldError(f"points have shape {points.shape}; this field needs (N, {self.centres.shape[1]})")
        return int(points.shape[1])


def parted(sums: Float, n: int) -> tuple[Points, Gradients]:
    """(N, n) displacements and (N, n, n) derivatives from the (N, 12) sums of `RadialField.add_to`."""
    gradients = sums[:, 3:].reshape(-1, 3, 3)[:, :n, :n]
    return np.ascontiguousarray(sums[:, :n]), np.ascontiguousarray(gradients)


@dataclass(frozen=True, slots=True)
class RadialBackend:
    """Interpolates handle displacements by a radial sum with a polynomial part.

    Parameters
    ----------
    kernel : str
        A name of `musclefit.fields.kernels.KERNELS`. Isochoric kernels give fields without divergence, in 3-D.
    scale : float, mm
        The kernel's own length (support, width, mollifier); not used by r, r2logr, r3, isochoric-r3, isochoric-r5.
    smoothing : float
        0 interpolates; larger values let the field miss noisy landmarks. Added to the diagonal of the kernel matrix.

    Raises
    ------
    FieldError
        The scale is not a positive number, or the smoothing negative.
    """

    kernel: str
    scale: float = 1.0
    smoothing: float = 0.0

    def __post_init__(self) -> None:
        kernel_named(self.kernel)
        if not self.scale > 0.0 or not np.isfinite(self.scale):
            raise FieldError(f"the kernel's scale is {self.scale} mm; it must be a positive number")
        if not self.smoothing >= 0.0:
            raise FieldError(f"smoothing is {self.smoothing}; it must be 0 or more")

    def fit(self, at: Points, displacements: Points) -> RadialField:
        """The field that takes the (m, n) displacements at the (m, n) handles.

        Raises
        ------
        FieldError
            Handles coincide, or the kernel is too wide for their spacing.
        """
        return self.factor(at).field(displacements)

    def factor(self, at: Points) -> RadialFactor:
        """The factorised system of one configuration of handles, to be reused for many displacements.

        Raises
        ------
        FieldError
            Handles coincide or nearly so, or an isochoric kernel is to be used in the plane.
        """
        at = np.ascontiguousarray(at, dtype=np.float64)
        kernel = kernel_named(self.kernel)
        m, n = at.shape
        if kernel.isochoric and n != 3:
            raise FieldError(f"kernel {self.kernel!r} needs points in space; these have {n} coordinates")
        origin = at.mean(axis=0)
        local = at - origin
        extent = float(np.abs(local).max()) or 1.0
        matrix = np.empty((kernel.components * m,) * 2)
        spatial = np.ascontiguousarray(_in_space(local))
        _sums(kernel).matrix(self.scale, spatial, np.ascontiguousarray(spatial.T), matrix)
        if self.smoothing:
            matrix[np.diag_indices(len(matrix))] += self.smoothing
        polynomials = _polynomials(local / extent, kernel)
        return RadialFactor(self, at, origin, extent, SaddleFactor.of(matrix, polynomials))


@dataclass(frozen=True, eq=False, slots=True)
class RadialFactor:
    """One configuration's factorised system."""

    backend: RadialBackend
    at: Points
    origin: Float
    extent: float
    saddle: SaddleFactor

    def field(self, displacements: Points) -> RadialField:
        """The field for (m, n) displacements, mm."""
        kernel = kernel_named(self.backend.kernel)
        n = self.at.shape[1]
        isochoric = kernel.isochoric
        data = np.ascontiguousarray(displacements, dtype=np.float64)
        weights, coefficients = self.saddle.solve(data.reshape(-1, 1) if isochoric else data)
        linear, translation = np.zeros((n, n)), np.zeros(n)
        terms = coefficients.size if isochoric else len(coefficients)
        if terms:
            if isochoric:
                translation = coefficients[:3, 0]
                linear = np.tensordot(coefficients[3:, 0], TRACELESS, axes=1)
            else:
                translation = coefficients[0]
                linear = coefficients[1:].T
        return RadialField(
            kernel=self.backend.kernel,
            scale=self.backend.scale,
            centres=self.at,
            weights=weights.reshape(-1, n),
            origin=self.origin,
            linear=linear / self.extent,
            translation=translation,
            polynomial_rank=self.saddle.rank,
            polynomial_terms=terms,
        )


def _sums(kernel: RadialKernel) -> RadialSums:
    return radial_sums(kernel.formula, isochoric=kernel.isochoric)


def _lane_sums(kernel: RadialKernel) -> LaneSums | None:
    return None if kernel.lanes is None else lane_sums(kernel.lanes.values, kernel.lanes.gradients)


def _traceless_basis() -> Float:
    """The 8 traceless 3x3 matrices: six off-diagonal, two diagonal, all of Frobenius norm 1."""
    basis = np.zeros((8, 3, 3))
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))):
        basis[k, i, j] = 1.0
    basis[6] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2.0)
    basis[7] = np.diag([1.0, 1.0, -2.0]) / np.sqrt(6.0)
    return basis


TRACELESS = frozen(_traceless_basis())


def _polynomials(local: Points, kernel: RadialKernel) -> Float:
    """Values of the polynomial part's terms at the handles: affine, or translations and traceless linear maps."""
    m, n = local.shape
    if kernel.polynomial_degree < 0 or kernel.compact:
        return np.zeros((kernel.components * m, 0))
    if kernel.components == 1:
        return np.hstack([np.ones((m, 1)), local])
    values = np.zeros((m, n, n + len(TRACELESS)))
    values[:, :, :n] = np.eye(n)
    values[:, :, n:] = np.einsum("kij,mj->mik", TRACELESS, local)
    return values.reshape(m * n, -1)


def _in_space(points: Points) -> Points:
    """Points of the plane embedded in space."""
    return points if points.shape[1] == 3 else np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
