r"""Fields that are exactly affine on and around given surfaces: a base field, and locks that take over near bones.

.. math:: D(x) = (1 - \sum_k w_k(x)) B(x) + \sum_k w_k(x) A_k(x)

B is the base field and A_k the affine displacement of bone k, whose weight w_k is 1 on the bone's surface, around it
and within it, and fades to 0 a few millimetres away. So D is A_k on the whole surface, whatever B is: a step made of D
moves the bone exactly. Near a bone B is close to A_k, so that the fading costs little strain: with e = A_k - B it is
:math:`e \otimes \nabla w_k`, a shear where e is along the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from musclefit.errors import FieldError
from musclefit.fields import enclosures, weights
from musclefit.fields.protocol import Field
from musclefit.geometry.arrays import Bool, Float, Gradients, Int, Points, frozen

ROUNDING = 1e-13
"""Of computed gradients and eigenvalues, in units of the sizes that they are made of."""


@runtime_checkable
class BoundedBase(Protocol):
    """What a base field must bound itself, beside its gradient."""

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Proved eigenvalue ranges over boxes and about those at their centres, (B, 2) each."""
        ...

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Displacements at the centres of boxes and radii, (B, n) each, mm."""
        ...


@dataclass(frozen=True, eq=False)
class WeightLattice:
    """Weights between 0 and 1 as a sum of quadratic B-splines on a lattice kept in bricks (`musclefit.fields.weights`).

    Parameters
    ----------
    low : (3,) float64, mm
        The lattice's first node.
    spacing_mm : float
    bricks : (b0, b1, b2) int32
        Row of each brick's values, ``weights.NOTHING`` or ``weights.WHOLE``.
    values : (R, 1000) uint16
    """

    low: Float
    spacing_mm: float
    bricks: NDArray[np.int32]
    values: NDArray[np.uint16]

    def __post_init__(self) -> None:
        object.__setattr__(self, "low", frozen(self.low))

    @classmethod
    def of(
        cls, low: Float, spacing_mm: float, *, bricks: NDArray[np.int32], places: Int, inner: NDArray[np.uint16]
    ) -> Self:
        """From the values of every brick's own nodes; bricks that see no other value than 0 or 1 need no row.

        Parameters
        ----------
        low : (3,) float64, mm
        spacing_mm : float
        bricks : (b0, b1, b2) int32
            As the record's, with rows of ``inner``.
        places : (R, 3) int64
            The brick of each row.
        inner : (R, 8, 8, 8) uint16
        """
        values = np.empty((len(inner), weights.ACROSS**3), dtype=np.uint16)
        weights.with_borders(bricks, places, inner, values)
        nothing, whole = (values == 0).all(axis=1), (values == weights.ONE).all(axis=1)
        kept = ~(nothing | whole)
        rows = np.where(nothing, weights.NOTHING, np.where(whole, weights.WHOLE, np.cumsum(kept) - 1))
        fewer = bricks.copy()
        fewer[tuple(places.T)] = rows
        return cls(low, spacing_mm, fewer, values[kept])

    def at(self, points: Points) -> tuple[Float, Points]:
        """Weights (N,) and gradients (N, 3), per mm, at (N, 3) points in the lattice's frame."""
        found, slopes = np.empty(len(points)), np.empty((len(points), 3))
        where = np.ascontiguousarray(points, dtype=np.float64)
        weights.weights_at(self.low, self.spacing_mm, self.bricks, self.values, where, found, slopes)
        return found, slopes

    def ranges(self, centres: Points, half_widths: Float, slopes: Points) -> Float:
        """Proved ranges over boxes: see `weights.weight_ranges`."""
        found = np.empty((len(centres), 4))
        weights.weight_ranges(
            self.low,
            self.spacing_mm,
            self.bricks,
            self.values,
            self._of_bricks,
            np.ascontiguousarray(centres),
            np.ascontiguousarray(half_widths),
            slopes,
            found,
        )
        return found

    @cached_property
    def _of_bricks(self) -> NDArray[np.int64]:
        found = np.zeros((len(self.values), 5), dtype=np.int64)
        weights.brick_ranges(self.values, found)
        return found


@dataclass(frozen=True, eq=False, slots=True)
class Lock:
    """One bone's affine displacement, and where it counts.

    Parameters
    ----------
    weight : WeightLattice
        In the bone's frame at rest.
    to_rest : (3, 3) float64
    shift : (3,) float64, mm
        A point x of the field stands for ``to_rest @ x + shift`` of the bone at rest.
    linear : (3, 3) float64
    translation : (3,) float64, mm
        The displacement at x is ``linear @ x + translation``.
    """

    weight: WeightLattice
    to_rest: Float
    shift: Float
    linear: Float
    translation: Float

    def __post_init__(self) -> None:
        for name in ("to_rest", "shift", "linear", "translation"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @classmethod
    def of_step(cls, weight: WeightLattice, before: tuple[Float, Float], after: tuple[Float, Float]) -> Self:
        """Of a Cayley step that takes a bone from one affine map of its rest shape to another.

        Parameters
        ----------
        weight : WeightLattice
        before, after : ((3, 3), (3,)) float64
            Linear part and translation, mm, from rest.

        Raises
        ------
        FieldError
            The bone turns by 180 degrees: its middle is flat.
        """
        middle, halfway = 0.5 * (before[0] + after[0]), 0.5 * (before[1] + after[1])
        if not abs(np.linalg.det(middle)) > 1e-6 * abs(np.linalg.det(before[0])):
            raise FieldError("a bone turns by about 180 degrees in one step; use smaller steps")
        to_rest: Float = np.asarray(np.linalg.inv(middle), dtype=np.float64)
        linear = (after[0] - before[0]) @ to_rest
        return cls(weight, to_rest, -to_rest @ halfway, linear, after[1] - before[1] - linear @ halfway)

    def displacement(self, points: Points) -> Points:
        """(N, 3) affine displacements, mm."""
        moved: Points = points @ self.linear.T + self.translation
        return moved

    def weights(self, points: Points) -> tuple[Float, Points]:
        """Weights (N,) and gradients (N, 3) at points of the field."""
        found, slopes = self.weight.at(points @ self.to_rest.T + self.shift)
        return found, slopes @ self.to_rest

    def ranges(self, centres: Points, half_widths: Float) -> Float:
        """(B, 4) over boxes: lowest and highest weight, largest gradient, and how far it gets from the centre's."""
        middles = centres @ self.to_rest.T + self.shift
        size = np.abs(centres).max(axis=1, initial=0.0)[:, None] + np.abs(self.shift).max()
        halves = half_widths @ np.abs(self.to_rest).T * (1.0 + 1e-14) + 1e-14 * size
        found = self.weight.ranges(middles, halves, self.weight.at(middles)[1])
        found[:, 2:] *= float(np.linalg.norm(self.to_rest, 2)) * (1.0 + 1e-12)
        return found

    def scaled(self, factor: float) -> Self:
        """With a displacement ``factor`` times as large."""
        return replace(self, linear=factor * self.linear, translation=factor * self.translation)


@dataclass(frozen=True, eq=False, slots=True)
class LockedField:
    """The base field with locks; see the module.

    Parameters
    ----------
    base : Field
        In space.
    locks : tuple of Lock
        Their weights sum to at most 1 everywhere (up to the rounding of their values).
    """

    base: Field
    locks: tuple[Lock, ...]

    def displacement(self, points: Points) -> Points:
        """(N, 3) displacements at (N, 3) points, mm."""
        free, parts = self._weights(points)
        values = np.zeros_like(points)
        some = np.flatnonzero(free != 0.0)
        values[some] = free[some, None] * self.base.displacement(np.ascontiguousarray(points[some]))
        for lock, (found, _) in zip(self.locks, parts, strict=True):
            on = np.flatnonzero(found)
            values[on] += found[on, None] * lock.displacement(points[on])
        return values

    def gradient(self, points: Points) -> Gradients:
        """(N, 3, 3) derivatives."""
        return self.displacement_and_gradient(points)[1]

    def displacement_and_gradient(self, points: Points) -> tuple[Points, Gradients]:
        """Both in one pass."""
        free, parts = self._weights(points)
        values, gradients = np.zeros_like(points), np.zeros((len(points), 3, 3))
        bare = np.zeros_like(points)
        some = np.flatnonzero(free != 0.0)
        bare[some], slopes = self.base.displacement_and_gradient(np.ascontiguousarray(points[some]))
        values[some] = free[some, None] * bare[some]
        gradients[some] = free[some, None, None] * slopes
        for lock, (found, steep) in zip(self.locks, parts, strict=True):
            on = np.flatnonzero(found)
            own = lock.displacement(points[on])
            values[on] += found[on, None] * own
            gradients[on] += found[on, None, None] * lock.linear + (own - bare[on])[:, :, None] * steep[on, None, :]
        return values, gradients

    def scaled(self, factor: float) -> Self:
        """The field ``factor`` times as strong."""
        return replace(self, base=self.base.scaled(factor), locks=tuple(lock.scaled(factor) for lock in self.locks))

    def locked(self, points: Points) -> Bool:
        """(N,) whether the field is exactly the displacement of one bone there."""
        whole: Bool = self._weights(points)[0] == 0.0
        return whole

    def gradient_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float]:
        """Rigorous enclosure of the gradient over boxes: see `protocol.Field`."""
        half_widths = np.broadcast_to(half_widths, centres.shape)
        return self._enclosed(self._boxes(centres, half_widths))

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Rigorous bounds of the eigenvalues of the gradient's symmetric part over boxes.

        As `RadialField.strain_bounds`, which judges the boxes that no lock touches.
        """
        base = self.base
        if not isinstance(base, BoundedBase):
            raise FieldError(
                f"a {type(base).__name__} does not bound its strain; it cannot be proved with locked bones"
            )
        half_widths = np.broadcast_to(half_widths, centres.shape)
        boxes = self._boxes(centres, half_widths)
        ranges, middles = np.empty((len(centres), 2)), np.empty((len(centres), 2))
        bare, mixed = boxes.bare, np.flatnonzero(~boxes.bare & ~boxes.whole)
        if bare.any():
            ranges[bare], middles[bare] = base.strain_bounds(centres[bare], half_widths[bare], enough=enough)
        for k, lock in enumerate(self.locks):
            own = boxes.whole & (boxes.weights[k, :, 0] == 1.0)
            ranges[own] = _symmetric_range(lock.linear)
            middles[own] = ranges[own]
        if mixed.size:
            part = boxes.only(mixed)
            gradients, radii = self._enclosed(part)
            values = np.linalg.eigvalsh(0.5 * (gradients + gradients.transpose(0, 2, 1)))[:, [0, -1]]
            off = radii + ROUNDING * np.abs(gradients).sum(axis=(1, 2))
            first = np.stack([values[:, 0] - off, values[:, 1] + off], axis=1)
            found = np.where(np.isnan(first), np.array([-np.inf, np.inf]), first)
            short = ~((found[:, 0] >= enough[0]) & (found[:, 1] <= enough[1]))
            if short.any():
                found[short] = enclosures.narrower(
                    found[short], self._blended(part.only(np.flatnonzero(short)), enough)
                )
            ranges[mixed], middles[mixed] = found, values
        return ranges, middles

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Rigorous enclosure of the displacement over boxes: values at the centres and radii, (B, 3) each, mm."""
        half_widths = np.broadcast_to(half_widths, centres.shape)
        boxes = self._boxes(centres, half_widths)
        gradients, radii = self._enclosed(boxes)
        values = self.displacement(centres)
        reach = np.linalg.norm(half_widths, axis=1) * (1.0 + 1e-14)
        wide = np.where(reach > 0.0, (np.linalg.norm(gradients, axis=(1, 2)) * (1.0 + 1e-13) + radii) * reach, 0.0)
        size = np.abs(centres).sum(axis=1) + 1.0
        rounding = np.zeros(len(centres))
        for lock in self.locks:
            rounding = np.maximum(
                rounding, ROUNDING * (np.abs(lock.linear).sum() * size + np.abs(lock.translation).sum())
            )
        touched = ~boxes.whole
        if touched.any():
            base = self.base
            assert isinstance(base, BoundedBase)
            here = np.ascontiguousarray(centres[touched])
            _, off = base.displacement_bounds(here, np.zeros_like(here))
            rounding[touched] += off.max(axis=1, initial=0.0)
        return values, np.repeat((wide + rounding)[:, None], centres.shape[1], axis=1)

    def _weights(self, points: Points) -> tuple[Float, list[tuple[Float, Points]]]:
        """What is left for the base field (N,), and the weights of each lock."""
        parts = [lock.weights(points) for lock in self.locks]
        free = np.ones(len(points))
        for found, _ in parts:
            free -= found
        return free, parts

    def _boxes(self, centres: Points, half_widths: Float) -> _Boxes:
        found = [lock.ranges(centres, half_widths) for lock in self.locks]
        ranges = np.stack(found) if found else np.zeros((0, len(centres), 4))
        bare: Bool = (ranges[:, :, 1] == 0.0).all(axis=0)
        whole: Bool = (ranges[:, :, 0] == 1.0).any(axis=0) & ((ranges[:, :, 1] == 0.0).sum(axis=0) >= len(found) - 1)
        return _Boxes(centres, half_widths, ranges, bare, whole)

    def _enclosed(self, boxes: _Boxes) -> tuple[Gradients, Float]:
        """Gradients at the centres of boxes, and how far they get from them.

        With c the centre, e = A_k - B and D' the gradient of the field, D' - D'(c) is the sum of (1 - W)(B' - B'(c)),
        (w_k - w_k(c))(A_k' - B'(c)), (e - e(c)) w_k' and e(c)(w_k' - w_k'(c)) over all k, W the sum of all w_k.
        """
        centres, halves = boxes.centres, boxes.half_widths
        gradients, radii = np.zeros((len(centres), 3, 3)), np.zeros(len(centres))
        for k, lock in enumerate(self.locks):
            own = boxes.whole & (boxes.weights[k, :, 0] == 1.0)
            gradients[own] = lock.linear
        rest = np.flatnonzero(~boxes.whole)
        if not rest.size:
            return gradients, radii
        here, half = np.ascontiguousarray(centres[rest]), np.ascontiguousarray(halves[rest])
        steep, spread = self.base.gradient_bounds(here, half)
        known: Bool = np.asarray(np.isfinite(steep).all(axis=(1, 2)), dtype=np.bool_)
        steep, spread = np.where(known[:, None, None], steep, 0.0), np.where(known, spread, np.inf)
        touched = ~boxes.bare[rest]
        if touched.any():
            # bounds of the base's value at the centres carry its own rounding
            base = self.base
            if not isinstance(base, BoundedBase):
                raise FieldError(f"a {type(base).__name__} does not bound its values; it cannot be proved with locks")
            places = here[touched]
            bare, rounding = base.displacement_bounds(places, np.zeros_like(places))
            slopes, wide = steep[touched], spread[touched]
            ranges = boxes.weights[:, rest[touched]]
            reach = np.linalg.norm(half[touched], axis=1) * (1.0 + 1e-14)
            total = np.array(slopes)
            free = (
                np.maximum(np.abs(1.0 - ranges[:, :, 0].sum(axis=0)), np.abs(1.0 - ranges[:, :, 1].sum(axis=0))) + 1e-14
            )
            off = free * wide
            for k, lock in enumerate(self.locks):
                found, steepness = lock.weights(places)
                apart = lock.displacement(places) - bare
                turned = lock.linear - slopes
                size = np.linalg.norm(turned, axis=(1, 2)) * (1.0 + 1e-13)
                total += found[:, None, None] * turned + apart[:, :, None] * steepness[:, None, :]
                length = np.linalg.norm(apart, axis=1) + rounding.max(axis=1, initial=0.0)
                varied = np.maximum(ranges[k, :, 1] - found, found - ranges[k, :, 0])
                varied = np.minimum(varied, ranges[k, :, 2] * reach + 1e-14)
                off += varied * size + _times((size + wide) * reach, ranges[k, :, 2]) + length * ranges[k, :, 3]
                scale = np.abs(places).sum(axis=1) * np.abs(lock.linear).sum() + np.abs(lock.translation).sum()
                off += _times(rounding.max(axis=1, initial=0.0) + ROUNDING * scale, ranges[k, :, 2])
                off += ROUNDING * (size + length * ranges[k, :, 2])
            off = off * (1.0 + 1e-12) + ROUNDING * np.abs(total).sum(axis=(1, 2))
            steep[touched], spread[touched] = total, np.where(np.isnan(off), np.inf, off)
        gradients[rest], radii[rest] = np.where(known[:, None, None], steep, np.nan), spread
        return gradients, radii

    def _blended(self, boxes: _Boxes, enough: tuple[float, float]) -> Float:
        """Ranges from the base field's own, tighter than its gradient's, and what fading adds at most."""
        base = self.base
        assert isinstance(base, BoundedBase)
        here, half = np.ascontiguousarray(boxes.centres), np.ascontiguousarray(boxes.half_widths)
        own, _ = base.strain_bounds(here, half, enough=enough)
        steep, spread = base.gradient_bounds(here, half)
        bare, rounding = base.displacement_bounds(here, np.zeros_like(here))
        shares = 1.0 - boxes.weights[:, :, 1].sum(axis=0) - 1e-14, 1.0 - boxes.weights[:, :, 0].sum(axis=0) + 1e-14
        products = np.stack([share * side for share in shares for side in own.T])
        low, high = products.min(axis=0), products.max(axis=0)
        reach = np.linalg.norm(half, axis=1) * (1.0 + 1e-14)
        for k, lock in enumerate(self.locks):
            apart = lock.displacement(here) - bare
            size = np.linalg.norm(lock.linear - steep, axis=(1, 2)) + spread
            length = np.linalg.norm(apart, axis=1) + rounding.max(axis=1, initial=0.0) + size * reach
            more = _times(length, boxes.weights[k, :, 2])
            least, most = _symmetric_range(lock.linear)
            low += np.minimum(least, 0.0) * boxes.weights[k, :, 1] - more
            high += np.maximum(most, 0.0) * boxes.weights[k, :, 1] + more
        slack = 1e-12 * (1.0 + np.abs(low) + np.abs(high))
        found = np.stack([low - slack, high + slack], axis=1)
        return np.where(np.isnan(found), np.array([-np.inf, np.inf]), found)


@dataclass(frozen=True, eq=False, slots=True)
class _Boxes:
    """Boxes with the proved ranges (K, B, 4) of every lock's weight; bare ones see none, whole ones one bone alone."""

    centres: Points
    half_widths: Float
    weights: Float
    bare: Bool
    whole: Bool

    def only(self, kept: NDArray[np.int64]) -> _Boxes:
        return _Boxes(
            self.centres[kept], self.half_widths[kept], self.weights[:, kept], self.bare[kept], self.whole[kept]
        )


def _times(a: Float, b: Float) -> Float:
    """Products in which nothing times infinity is nothing."""
    product: Float = np.where(b > 0.0, a * np.where(b > 0.0, b, 1.0), 0.0)
    return product


def _symmetric_range(matrix: Float) -> Float:
    values = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[[0, -1]]
    slack = ROUNDING * np.abs(matrix).sum() + 1e-280
    found: Float = values + np.array([-slack, slack])
    return found
