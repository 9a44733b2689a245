"""Takes a radial field and boxes, gives proved enclosures of its value, gradient and strain over each of them.

A proof speaks of the field as a formula with the numbers of the record taken as exact; what the fast loops compute of
it is off by their own rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from musclefit.errors import FieldError
from musclefit.fields.enclosures.radial_sums import BoxSums, box_sums
from musclefit.fields.enclosures.source_terms import rounding_share
from musclefit.fields.enclosures.values import value_sums
from musclefit.fields.evaluation.neighbours import Cells
from musclefit.fields.kernels import RadialKernel, kernel_named
from musclefit.geometry.arrays import Float, Gradients, Points

BLUR = 8.0 * float(np.finfo(np.float64).eps)
"""Of the largest local coordinates: how far a local position, a difference of two and its computed length are off."""


class RadialSum(Protocol):
    """What a radial field is as a formula; `musclefit.fields.radial.RadialField` describes the attributes."""

    @property
    def kernel(self) -> str:
        """A name of `musclefit.fields.kernels.KERNELS`."""
        ...

    @property
    def scale(self) -> float:
        """The kernel's own length, mm."""
        ...

    @property
    def centres(self) -> Points:
        """(m, n), mm."""
        ...

    @property
    def weights(self) -> Float:
        """(m, n)."""
        ...

    @property
    def origin(self) -> Float:
        """(n,), mm."""
        ...

    @property
    def linear(self) -> Float:
        """(n, n)."""
        ...

    @property
    def translation(self) -> Float:
        """(n,), mm."""
        ...


@dataclass(frozen=True, slots=True)
class _Boxes:
    """Boxes made local to a field's origin, in space, with the field as the loops take it."""

    field: tuple[Any, ...]
    local: Points
    half_widths: Float
    blur: float


def gradient_bounds(field: RadialSum, centres: Points, half_widths: Float, *, balls: Float) -> tuple[Gradients, Float]:
    """Enclose the gradient over boxes, or over their parts within ``balls`` (B,) of the centres.

    See `musclefit.fields.protocol.Field.gradient_bounds`.

    Raises
    ------
    FieldError
        Boxes of other dimensions than the field's, or half widths that are no sizes.
    """
    boxes, n = _prepared(field, centres, half_widths), centres.shape[1]
    gradients, radii = np.empty((len(centres), 3, 3)), np.empty(len(centres))
    _sums_of(kernel_named(field.kernel)).gradients(
        *boxes.field, boxes.local, boxes.half_widths, balls, boxes.blur, gradients, radii
    )
    return np.ascontiguousarray(gradients[:, :n, :n]), radii


def strain_bounds(
    field: RadialSum, centres: Points, half_widths: Float, *, balls: Float, enough: tuple[float, float]
) -> tuple[Float, Float]:
    """Bound the eigenvalues of the strain over boxes, or over their parts within ``balls`` (B,) of the centres.

    See `musclefit.fields.radial.RadialField.strain_bounds`.

    Raises
    ------
    FieldError
        Boxes of other dimensions than the field's, or half widths that are no sizes.
    """
    found = gradient_and_strain_bounds(field, centres, half_widths, balls=balls, enough=enough)
    return found.ranges, found.middles


class GradientAndStrain(NamedTuple):
    """What one pass over the sources proves: see `gradient_bounds` and `strain_bounds`."""

    gradients: Gradients
    radii: Float
    ranges: Float
    middles: Float


def gradient_and_strain_bounds(
    field: RadialSum, centres: Points, half_widths: Float, *, balls: Float, enough: tuple[float, float]
) -> GradientAndStrain:
    """Both `gradient_bounds` and `strain_bounds`, by the same sums.

    Raises
    ------
    FieldError
        Boxes of other dimensions than the field's, or half widths that are no sizes.
    """
    boxes, n = _prepared(field, centres, half_widths), centres.shape[1]
    gradients, radii = np.empty((len(centres), 3, 3)), np.empty(len(centres))
    ranges, middles = np.empty((len(centres), 2)), np.empty((len(centres), 2))
    _sums_of(kernel_named(field.kernel)).strains(
        *boxes.field,
        boxes.local,
        boxes.half_widths,
        balls,
        boxes.blur,
        n == 2,
        np.array(enough, dtype=float),
        gradients,
        radii,
        ranges,
        middles,
    )
    return GradientAndStrain(np.ascontiguousarray(gradients[:, :n, :n]), radii, ranges, middles)


def displacement_bounds(field: RadialSum, centres: Points, half_widths: Float) -> tuple[Points, Float]:
    """Enclose the displacement over boxes; see `musclefit.fields.radial.RadialField.displacement_bounds`.

    Raises
    ------
    FieldError
        Boxes of other dimensions than the field's, or half widths that are no sizes.
    """
    boxes, n = _prepared(field, centres, half_widths), centres.shape[1]
    scale, _, table, _, sources, weights, sizes, _ = boxes.field
    summed, errors = np.empty_like(boxes.local), np.empty(len(centres))
    kernel = kernel_named(field.kernel)
    known = kernel.proved()
    slope = table[4].max() / (1.0 if known.extent is None else scale)
    add = value_sums(known.values, known.steepest, isochoric=kernel.isochoric)
    cells = Cells.single(len(sizes))
    if kernel.compact and len(sizes):  # 4 blurs: rounding takes no source into a cell beyond those around a point
        cells = Cells.of(sources.T, width=(scale + 4.0 * boxes.blur) * (1.0 + 1e-9))
        sources, weights, sizes = (np.ascontiguousarray(a[..., cells.order]) for a in (sources, weights, sizes))
    where = cells.low, cells.width, cells.counts, cells.starts
    add(scale, slope, sources, weights, sizes, *where, boxes.local, boxes.blur, summed, errors)
    affine = field.translation + (centres - field.origin) @ field.linear.T
    values: Points = affine + summed[:, :n]
    parts = (
        np.abs(field.translation).sum() + (np.abs(boxes.local).sum(axis=1) + boxes.blur) * np.abs(field.linear).sum()
    )
    share = rounding_share(len(sizes))
    radii = np.repeat((errors + share * (parts + np.abs(values).max(axis=1)))[:, None], n, axis=1)
    if half_widths.any():
        gradients, spread = gradient_bounds(field, centres, half_widths, balls=endless(centres))
        diagonals = np.linalg.norm(half_widths, axis=1)
        radii += np.einsum("bik,bk->bi", np.abs(gradients), half_widths) + (spread * diagonals)[:, None]
    return values, radii * (1.0 + 2.0 * share)


def _sums_of(kernel: RadialKernel) -> BoxSums:
    known = kernel.proved()
    return box_sums(known.terms, isochoric=kernel.isochoric, second_order=known.second_order)


def endless(centres: Points) -> Float:
    """Infinite balls: whole boxes."""
    return np.full(len(centres), np.inf)


def cubes(radii: Float, n: int) -> Float:
    """(B, n) half widths of the cubes around balls."""
    return np.repeat(np.asarray(radii, dtype=np.float64)[:, None], n, axis=1)


def _prepared(field: RadialSum, centres: Points, half_widths: Float) -> _Boxes:
    n = field.centres.shape[1]
    if centres.ndim != 2 or centres.shape[1] != n or half_widths.shape != centres.shape:
        raise FieldError(
            f"boxes have centres {centres.shape} and half widths {half_widths.shape}; this field needs (B, {n}) of both"
        )
    if not (half_widths >= 0.0).all():
        raise FieldError("half widths of boxes must be numbers of at least 0")
    kernel = kernel_named(field.kernel)
    known = kernel.proved()
    sources, local = field.centres - field.origin, centres - field.origin
    largest = sum(float(np.abs(a).max(initial=0.0)) for a in (sources, local))
    weights = _in_space(field.weights)
    sizes = np.hypot(np.hypot(weights[:, 0], weights[:, 1]), weights[:, 2]) * (1.0 + 1e-15) + 1e-300
    linear = np.zeros((3, 3))
    linear[:n, :n] = field.linear
    return _Boxes(
        field=(
            field.scale,
            1.0 if known.extent is None else known.extent,
            known.majorants,
            field.scale if kernel.compact else np.inf,
            np.ascontiguousarray(_in_space(sources).T),
            np.ascontiguousarray(weights.T),
            sizes,
            linear,
        ),
        local=np.ascontiguousarray(_in_space(local)),
        half_widths=np.ascontiguousarray(_in_space(np.asarray(half_widths, dtype=np.float64))),
        blur=max(BLUR * largest, 1e-100),
    )


def _in_space(points: Points) -> Points:
    return points if points.shape[1] == 3 else np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def narrower(a: Float, b: Float) -> Float:
    """What two proved ranges (B, 2) of the same eigenvalues prove together."""
    both: Float = np.stack([np.maximum(a[:, 0], b[:, 0]), np.minimum(a[:, 1], b[:, 1])], axis=1)
    return both
