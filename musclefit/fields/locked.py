r"""Fields that are exactly affine on and around given surfaces: a base field, and locks that take over near bones.

.. math:: D(x) = (1 - \sum_k w_k(x)) B(x) + \sum_k w_k(x) A_k(x)

B is the base field and A_k the affine displacement of bone k, whose weight w_k is 1 on the bone's surface, around it
and within it, and fades to 0 a few millimetres away. So D is A_k on the whole surface, whatever B is: a step made of D
moves the bone exactly. Near a bone B is close to A_k, so that the fading costs little strain: with e = A_k - B it is
:math:`e \otimes \nabla w_k`, a shear where e is along the surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from musclefit.errors import FieldError
from musclefit.fields.enclosures import radial as enclosures
from musclefit.fields.enclosures.jets import Jets
from musclefit.fields.evaluation import bricks
from musclefit.fields.protocol import Field, prepared
from musclefit.geometry.arrays import Bool, Float, Gradients, Int, Points, frozen

ROUNDING = 1e-13
"""Of computed gradients and eigenvalues, in units of the sizes that they are made of."""

FEW_TURNS = 7
"""Known directions along which a weight may turn over a box: as many as three bones beside each other make."""

AT_ONCE = 16384
"""Boxes whose displacements and gradients are bounded at once: what they take in memory grows with the bones."""


@runtime_checkable
class BoundedBase(Protocol):
    """What a base field must bound itself, beside its gradient."""

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Proved eigenvalue ranges over boxes and about those at their centres, (B, 2) each."""
        ...

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Displacements at the centres of boxes and radii, (B, n) each, mm."""
        ...


@runtime_checkable
class QuicklyBounded(Protocol):
    """A base field that has a cheaper enclosure of its gradient, which is about as good for narrow boxes."""

    def gradient_and_spreads(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float, Float]:
        """As ``gradient_bounds``, and how far the eigenvalues of the strain get from those of the centres', (B,)."""
        ...


@dataclass(frozen=True, eq=False)
class Nearness:
    """Distance from a bone, made smooth: a sum of quadratic B-splines on a lattice in bricks.

    See `musclefit.fields.evaluation.bricks`. It runs from ``-depth_mm`` deep within the bone to ``reach_mm`` far from
    it, and is no more than ``surface_mm`` at any place of the bone's surface.

    Parameters
    ----------
    low : (3,) float64, mm
        The lattice's first node.
    spacing_mm : float
    bricks : (b0, b1, b2) int32
        Row of each brick's values, ``bricks.NOTHING`` (out of reach) or ``bricks.WHOLE`` (deep within).
    values : (R, 1000) uint16
        From 0 at ``reach_mm`` to ``bricks.ONE`` at ``-depth_mm``.
    reach_mm, depth_mm, surface_mm : float
    """

    low: Float
    spacing_mm: float
    bricks: NDArray[np.int32]
    values: NDArray[np.uint16]
    reach_mm: float
    depth_mm: float
    surface_mm: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "low", frozen(self.low))

    def at(self, points: Points) -> tuple[Float, Points]:
        """Distances (N,), mm, and their gradients (N, 3) at (N, 3) points of the bone at rest."""
        return self.moved_at(points, np.eye(3), np.zeros(3))

    def moved_at(self, points: Points, to_rest: Float, shift: Float) -> tuple[Float, Points]:
        """The same at (N, 3) points x that stand for ``to_rest @ x + shift``; gradients are by x."""
        found, slopes = np.empty(len(points)), np.empty((len(points), 3))
        where = np.ascontiguousarray(points, dtype=np.float64)
        bricks.moved_values_at(*self._lattice, to_rest, shift, where, found, slopes)
        whole = self.reach_mm + self.depth_mm
        return self.reach_mm - whole * found, -whole * slopes

    def ranges(self, centres: Points, half_widths: Float) -> Float:
        """(B, 2) lowest and highest distance over boxes, mm."""
        found = np.empty((len(centres), 2))
        bricks.value_ranges(*self._lattice, self._of_bricks, *_contiguous(centres, half_widths), found)
        highest_first: Float = self.reach_mm - (self.reach_mm + self.depth_mm) * found
        return highest_first[:, ::-1]

    def slope_ranges(self, centres: Points, half_widths: Float, slopes: Points) -> Float:
        """(B, 2) over boxes: the largest slope, and how far slopes get from the centre's (B, 3)."""
        found = np.empty((len(centres), 2))
        whole = self.reach_mm + self.depth_mm
        places = _contiguous(centres, half_widths, slopes / -whole)
        bricks.slope_ranges(*self._lattice, self._of_bricks, *places, found)
        steep: Float = whole * found
        return steep

    @property
    def _lattice(self) -> tuple[Float, float, NDArray[np.int32], NDArray[np.uint16]]:
        return self.low, self.spacing_mm, self.bricks, self.values

    @cached_property
    def _of_bricks(self) -> NDArray[np.int64]:
        found = np.zeros((len(self.values), 5), dtype=np.int64)
        bricks.brick_ranges(self.values, found)
        return found


@dataclass(frozen=True, slots=True)
class Fade:
    """Where a bone counts: near it, and only where no other is.

    The weight of bone k is the product of how near it is, whole up to its surface and nothing ``over_mm`` farther away,
    and for each other bone j of how much nearer it is than j: nothing where both are as near, whole where j is farther
    away by the smaller ``apart_mm`` of the two. So no place sees two bones, and between bones that touch none counts.

    Parameters
    ----------
    over_mm, apart_mm : float
    """

    over_mm: float
    apart_mm: float


@dataclass(frozen=True, eq=False, slots=True)
class Lock:
    """One bone's affine displacement, and where the bone is.

    Parameters
    ----------
    nearness : Nearness
        Of the bone at rest.
    fade : Fade
    to_rest : (3, 3) float64
    shift : (3,) float64, mm
        A point x of the field stands for ``to_rest @ x + shift`` of the bone at rest.
    linear : (3, 3) float64
    translation : (3,) float64, mm
        The displacement at x is ``linear @ x + translation``.
    """

    nearness: Nearness
    fade: Fade
    to_rest: Float
    shift: Float
    linear: Float
    translation: Float

    def __post_init__(self) -> None:
        for name in ("to_rest", "shift", "linear", "translation"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @classmethod
    def of_step(cls, nearness: Nearness, fade: Fade, before: tuple[Float, Float], after: tuple[Float, Float]) -> Self:
        """Of a Cayley step that takes a bone from one affine map of its rest shape to another.

        Parameters
        ----------
        nearness : Nearness
        fade : Fade
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
        return cls(nearness, fade, to_rest, -to_rest @ halfway, linear, after[1] - before[1] - linear @ halfway)

    def displacement(self, points: Points) -> Points:
        """(N, 3) affine displacements, mm."""
        moved: Points = points @ self.linear.T + self.translation
        return moved

    def distances(self, points: Points) -> tuple[Float, Points]:
        """Distances from the bone (N,), mm at rest, and their gradients (N, 3) at points of the field."""
        return self.nearness.moved_at(points, self.to_rest, self.shift)

    def near(self, points: Points) -> tuple[Int, Float, Points]:
        """Which points are so near that the lock may have a weight, their distances and the gradients of these."""
        found, slopes = self.distances(points)
        near = np.flatnonzero(found < self.nearness.surface_mm + self.fade.over_mm)
        return near, found[near], slopes[near]

    def over(self, centres: Points, half_widths: Float) -> Jets:
        """The distances over boxes; nothing is known of their slopes but at the centres (see `with_slopes`)."""
        ranges = self.nearness.ranges(*self._at_rest(centres, half_widths))
        value, slope = self.distances(centres)
        unknown = np.full(len(centres), np.inf)
        return Jets(value, slope, ranges[:, 0], ranges[:, 1], unknown, unknown.copy()).widened()

    def with_slopes(self, jets: Jets, some: Int, centres: Points, half_widths: Float) -> Jets:
        """The distances over boxes, with bounds of their slopes in some of them."""
        here, half = centres[some], half_widths[some]
        part, turned = jets.only(some), np.linalg.norm(self.to_rest, 2) * (1.0 + 1e-12)
        at_rest = part.slope @ np.linalg.inv(self.to_rest)
        ranges = turned * self.nearness.slope_ranges(*self._at_rest(here, half), at_rest)
        known = replace(part, steep=ranges[:, 0], loose=ranges[:, 1])
        return jets.put(some, known.within(np.linalg.norm(half, axis=1) * (1.0 + 1e-12)))

    def may_count(self, distance: Jets) -> Bool:
        """(B,) boxes in which its weight may be more than 0."""
        near: Bool = distance.low < self.nearness.surface_mm + self.fade.over_mm
        return near

    def _at_rest(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Centres and half widths of boxes around where boxes are on the bone at rest."""
        size = np.abs(centres).max(axis=1, initial=0.0)[:, None] + np.abs(self.shift).max()
        halves = half_widths @ np.abs(self.to_rest).T * (1.0 + 1e-14) + 1e-14 * size
        return centres @ self.to_rest.T + self.shift, halves

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
    """

    base: Field
    locks: tuple[Lock, ...]

    def displacement(self, points: Points) -> Points:
        """(N, 3) displacements at (N, 3) points, mm."""
        held = self._held(points)
        values = np.zeros_like(points)
        some = np.flatnonzero(~_whole(held, len(points)))
        values[some] = self.base.displacement(np.ascontiguousarray(points[some]))
        for lock, at in zip(self.locks, held, strict=True):
            values[at.places] += at.weights[:, None] * (lock.displacement(points[at.places]) - values[at.places])
        return values

    def gradient(self, points: Points) -> Gradients:
        """(N, 3, 3) derivatives."""
        return self.displacement_and_gradient(points)[1]

    def displacement_and_gradient(self, points: Points) -> tuple[Points, Gradients]:
        """Both in one pass."""
        held = self._held(points)
        whole = _whole(held, len(points))
        if whole.any():
            values, gradients = np.zeros_like(points), np.zeros((len(points), 3, 3))
            some = np.flatnonzero(~whole)
            values[some], gradients[some] = self.base.displacement_and_gradient(np.ascontiguousarray(points[some]))
        else:
            values, gradients = self.base.displacement_and_gradient(np.ascontiguousarray(points))
        for lock, at in zip(self.locks, held, strict=True):
            apart = lock.displacement(points[at.places]) - values[at.places]
            turned = lock.linear - gradients[at.places]
            values[at.places] += at.weights[:, None] * apart
            gradients[at.places] += at.weights[:, None, None] * turned + apart[:, :, None] * at.slopes[:, None, :]
        return values, gradients

    def scaled(self, factor: float) -> Self:
        """The field ``factor`` times as strong."""
        return replace(self, base=self.base.scaled(factor), locks=tuple(lock.scaled(factor) for lock in self.locks))

    def prepared(self) -> Self:
        """The same field, whose base is prepared where it can be."""
        return replace(self, base=prepared(self.base))

    def locked(self, points: Points) -> Bool:
        """(N,) whether the field is exactly the displacement of one bone there."""
        return _whole(self._held(points), len(points))

    def gradient_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float]:
        """Rigorous enclosure of the gradient over boxes: see `protocol.Field`."""
        return _some_at_once(self._gradient_bounds, centres, half_widths)

    def _gradient_bounds(self, centres: Points, half_widths: Float) -> tuple[Gradients, Float]:
        boxes = self._boxes(centres, half_widths)
        return self._enclosed(boxes, self._bare(boxes))

    def strain_bounds(self, centres: Points, half_widths: Float, *, enough: tuple[float, float]) -> tuple[Float, Float]:
        """Rigorous bounds of the eigenvalues of the gradient's symmetric part over boxes.

        As `RadialField.strain_bounds`, which judges the boxes that no lock touches.

        Raises
        ------
        FieldError
            The field beneath the locks bounds no strain.
        """
        base = self.base
        if not isinstance(base, BoundedBase):
            raise FieldError(
                f"a {type(base).__name__} does not bound its strain; it cannot be proved with locked bones"
            )
        half_widths = np.broadcast_to(half_widths, centres.shape)
        boxes = self._boxes(centres, half_widths)
        ranges, middles = np.empty((len(centres), 2)), np.empty((len(centres), 2))
        alone, mixed = boxes.bare, np.flatnonzero(~boxes.bare & ~boxes.whole)
        if alone.any():
            ranges[alone], middles[alone] = base.strain_bounds(centres[alone], half_widths[alone], enough=enough)
        for k, lock in enumerate(self.locks):
            own = boxes.own == k
            ranges[own] = _symmetric_range(lock.linear)
            middles[own] = ranges[own]
        if mixed.size:
            part = boxes.only(mixed)
            bare = self._bare(part, quick=True)
            found, values = self._strains(part, bare)
            wide = np.linalg.norm(part.half_widths, axis=1) > min(lock.nearness.spacing_mm for lock in self.locks)
            short = np.flatnonzero(wide & _outside(found, enough))
            if short.size:
                found[short] = enclosures.narrower(
                    found[short], self._blended(part.only(short), bare.only(short), enough)
                )
            ranges[mixed], middles[mixed] = found, values
        return ranges, middles

    def _strains(self, boxes: _Boxes, bare: _Bare) -> tuple[Float, Float]:
        """Ranges of the strain's eigenvalues over boxes that see both a lock and the base, and those at the centres."""
        gradients, radii = self._enclosed(boxes, bare, strain=True)
        values: Float = np.linalg.eigvalsh(0.5 * (gradients + gradients.transpose(0, 2, 1)))[:, [0, -1]].astype(
            np.float64
        )
        off = radii + ROUNDING * np.abs(gradients).sum(axis=(1, 2))
        found = np.stack([values[:, 0] - off, values[:, 1] + off], axis=1)
        return np.where(np.isnan(found), np.array([-np.inf, np.inf]), found), values

    def displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        """Rigorous enclosure of the displacement over boxes: values at the centres and radii, (B, 3) each, mm."""
        return _some_at_once(self._displacement_bounds, centres, half_widths)

    def _displacement_bounds(self, centres: Points, half_widths: Float) -> tuple[Points, Float]:
        boxes = self._boxes(centres, half_widths)
        values = self.displacement(centres)
        reach = np.linalg.norm(half_widths, axis=1) * (1.0 + 1e-14)
        wide, some = np.zeros(len(centres)), np.flatnonzero(reach > 0.0)
        if some.size:
            part = boxes.only(some)
            gradients, radii = self._enclosed(part, self._bare(part))
            wide[some] = (np.linalg.norm(gradients, axis=(1, 2)) * (1.0 + 1e-13) + radii) * reach[some]
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

    def weights(self, points: Points) -> tuple[Float, Points]:
        """Of every lock (K, N), and their gradients (K, N, 3), per mm; at most one is not 0 at any point."""
        count = len(self.locks)
        weights, slopes = np.zeros((count, len(points))), np.zeros((count, len(points), 3))
        for k, at in enumerate(self._held(points)):
            weights[k, at.places], slopes[k, at.places] = at.weights, at.slopes
        return weights, slopes

    def _apart(self, k: int, j: int) -> float:
        return min(self.locks[k].fade.apart_mm, self.locks[j].fade.apart_mm)

    def _held(self, points: Points) -> list[_Held]:
        """Where each lock has a weight."""
        held = []
        for k, lock in enumerate(self.locks):
            near, own, steep = lock.near(points)
            risen, steepness = _risen((own - lock.nearness.surface_mm, steep), lock.fade.over_mm)
            value, slope = 1.0 - risen, -steepness
            for j, other in enumerate(self.locks):
                if j != k and near.size:
                    distances, slopes = other.distances(points[near])
                    farther = distances - own, slopes - steep
                    value, slope = _product((value, slope), _risen(farther, self._apart(k, j)))
            some = value != 0.0
            held.append(_Held(near[some], value[some], slope[some]))
        return held

    def _boxes(self, centres: Points, half_widths: Float) -> _Boxes:
        count = len(centres)
        found = self._distances(centres, half_widths)
        reach = np.linalg.norm(half_widths, axis=1) * (1.0 + 1e-12)
        weights = []
        bare, own_lock = np.ones(count, dtype=bool), np.full(count, -1)
        for k, (lock, own) in enumerate(zip(self.locks, found, strict=True)):
            near = np.flatnonzero(lock.may_count(own))
            distance = own.only(near)
            jets = distance.risen(lock.nearness.surface_mm, lock.fade.over_mm).complement()
            for j, other in enumerate(found):
                if j == k:
                    continue
                close = np.flatnonzero(other.low[near] - distance.high < self._apart(k, j))
                if close.size:  # elsewhere it leaves all of the weight
                    farther = other.only(near[close]).minus(distance.only(close), reach[near[close]])
                    jets = jets.times_some(close, farther.risen(0.0, self._apart(k, j))).with_few_turns(FEW_TURNS)
            weights.append(_Weight(near, jets))
            bare[near[jets.high != 0.0]] = False
            own_lock[near[jets.low == 1.0]] = k
        return _Boxes(centres, half_widths, tuple(weights), bare, own_lock)

    def _distances(self, centres: Points, half_widths: Float) -> list[Jets]:
        """From every lock's bone over boxes; slopes are bounded where a weight may be neither 0 nor 1."""
        found = [lock.over(centres, half_widths) for lock in self.locks]
        asked = np.zeros((len(found), len(centres)), dtype=bool)
        for k, (lock, own) in enumerate(zip(self.locks, found, strict=True)):
            near = lock.may_count(own)
            asked[k] |= near & (own.high > lock.nearness.surface_mm)
            for j, other in enumerate(found):
                if j != k:
                    close = near & (other.low - own.high < self._apart(k, j))
                    asked[k] |= close
                    asked[j] |= close
        for k, lock in enumerate(self.locks):
            found[k] = lock.with_slopes(found[k], np.flatnonzero(asked[k]), centres, half_widths)
        return found

    def _bare(self, boxes: _Boxes, *, quick: bool = False) -> _Bare:
        """What is proved of the base field over boxes that see it."""
        base, n = self.base, len(boxes.centres)
        steep, spread, strained = np.zeros((n, 3, 3)), np.zeros(n), np.zeros(n)
        values, rounding = np.zeros((n, 3)), np.zeros(n)
        seen = np.flatnonzero(~boxes.whole)
        if seen.size:
            here, half = np.ascontiguousarray(boxes.centres[seen]), np.ascontiguousarray(boxes.half_widths[seen])
            if quick and isinstance(base, QuicklyBounded):
                gradients, wide, by_strain = base.gradient_and_spreads(here, half)
            else:
                gradients, wide = base.gradient_bounds(here, half)
                by_strain = wide
            known: Bool = np.asarray(np.isfinite(gradients).all(axis=(1, 2)), dtype=np.bool_)
            steep[seen] = np.where(known[:, None, None], gradients, 0.0)
            spread[seen], strained[seen] = np.where(known, wide, np.inf), np.where(known, by_strain, np.inf)
        touched = np.flatnonzero(~boxes.whole & ~boxes.bare)
        if touched.size:
            # bounds of the base's value at the centres carry its own rounding
            if not isinstance(base, BoundedBase):
                raise FieldError(f"a {type(base).__name__} does not bound its values; it cannot be proved with locks")
            places = np.ascontiguousarray(boxes.centres[touched])
            values[touched], off = base.displacement_bounds(places, np.zeros_like(places))
            rounding[touched] = off.max(axis=1, initial=0.0)
        return _Bare(steep, spread, strained, values, rounding)

    def _enclosed(self, boxes: _Boxes, bare: _Bare, *, strain: bool = False) -> tuple[Gradients, Float]:
        """Gradients at the centres of boxes, and how far they get from them, or how far only their strain gets.

        With c the centre, e = A_k - B and D' the gradient of the field, D' - D'(c) is the sum of (1 - W)(B' - B'(c)),
        (w_k - w_k(c))(A_k' - B'(c)), (e - e(c)) w_k' and e(c)(w_k' - w_k'(c)) over all k, W the sum of all w_k. There
        e - e(c) is (A_k' - B'(c)) d at d from the centre, beside what B' varies by.
        """
        gradients, radii = np.array(bare.steep), np.array(bare.strained if strain else bare.spread)
        for k, lock in enumerate(self.locks):
            gradients[boxes.own == k] = lock.linear
        touched = np.flatnonzero(~boxes.whole & ~boxes.bare)
        if touched.size:
            part, found = boxes.only(touched), bare.only(touched)
            reach = np.linalg.norm(part.half_widths, axis=1) * (1.0 + 1e-14)
            total, wide = np.array(found.steep), found.spread
            off = part.most_left() * (found.strained if strain else wide)
            for lock, weight in zip(self.locks, part.weights, strict=True):
                some, jets = weight.places, weight.jets
                here, steep, unsure = part.centres[some], found.steep[some], found.rounding[some]
                apart = lock.displacement(here) - found.values[some]
                turned = lock.linear - steep
                size = np.linalg.norm(turned, axis=(1, 2)) * (1.0 + 1e-13)
                total[some] += jets.value[:, None, None] * turned + apart[:, :, None] * jets.slope[:, None, :]
                length = np.linalg.norm(apart, axis=1) + unsure
                varied = np.minimum(jets.varied(), jets.steep * reach[some] + 1e-14)
                spread = np.linalg.norm(np.einsum("bij,bj->bi", np.abs(turned), part.half_widths[some]), axis=1)
                more = _times(wide[some] * reach[some], jets.steep)
                if strain:
                    more += varied * _strain_size(turned) + jets.sheared(apart, unsure)
                    more += jets.sheared_by(turned, part.half_widths[some], spread)
                else:
                    more += varied * size + _times(spread, jets.steep) + length * jets.off
                scale = np.abs(here).sum(axis=1) * np.abs(lock.linear).sum() + np.abs(lock.translation).sum()
                more += _times(unsure + ROUNDING * scale, jets.steep)
                off[some] += more + ROUNDING * (size + length * jets.steep)
            off = off * (1.0 + 1e-12) + ROUNDING * np.abs(total).sum(axis=(1, 2))
            gradients[touched], radii[touched] = total, np.where(np.isnan(off), np.inf, off)
        gradients[np.isinf(bare.spread)] = np.nan  # the base field has no derivative there that a proof knows
        return gradients, radii

    def _blended(self, boxes: _Boxes, bare: _Bare, enough: tuple[float, float]) -> Float:
        """Ranges from the base field's own, tighter than its gradient's, and what fading adds at most."""
        base = self.base
        assert isinstance(base, BoundedBase)
        here, half = np.ascontiguousarray(boxes.centres), np.ascontiguousarray(boxes.half_widths)
        own, _ = base.strain_bounds(here, half, enough=enough)
        shares = boxes.least_left(), boxes.most_left()
        products = np.stack([share * side for share in shares for side in own.T])
        low, high = products.min(axis=0), products.max(axis=0)
        reach = np.linalg.norm(half, axis=1) * (1.0 + 1e-14)
        for lock, weight in zip(self.locks, boxes.weights, strict=True):
            some, jets = weight.places, weight.jets
            apart = lock.displacement(here[some]) - bare.values[some]
            size = np.linalg.norm(lock.linear - bare.steep[some], axis=(1, 2)) + bare.spread[some]
            length = np.linalg.norm(apart, axis=1) + bare.rounding[some] + size * reach[some]
            more = _times(length, jets.steep)
            least, most = _symmetric_range(lock.linear)
            low[some] += np.minimum(least, 0.0) * jets.high - more
            high[some] += np.maximum(most, 0.0) * jets.high + more
        slack = 1e-12 * (1.0 + np.abs(low) + np.abs(high))
        found = np.stack([low - slack, high + slack], axis=1)
        return np.where(np.isnan(found), np.array([-np.inf, np.inf]), found)


@dataclass(frozen=True, eq=False, slots=True)
class _Held:
    """The points at which a lock has a weight, the weights there, and their gradients, per mm."""

    places: Int
    weights: Float
    slopes: Points


def _contiguous(*arrays: Float) -> tuple[Float, ...]:
    return tuple(np.ascontiguousarray(array) for array in arrays)


def _whole(held: Sequence[_Held], count: int) -> Bool:
    """(N,) points at which one weight is 1."""
    whole: Bool = np.zeros(count, dtype=bool)
    for at in held:
        whole[at.places[at.weights == 1.0]] = True
    return whole


@dataclass(frozen=True, eq=False, slots=True)
class _Bare:
    """What is proved of the base field over boxes; nothing where one bone is whole.

    Its gradient (B, 3, 3) at the centres, how far it gets from that, and how far its strain does; its value (B, 3) at
    the centres and what rounding that may be off by.
    """

    steep: Gradients
    spread: Float
    strained: Float
    values: Points
    rounding: Float

    def only(self, kept: Int) -> _Bare:
        return _Bare(*(a[kept] for a in (self.steep, self.spread, self.strained, self.values, self.rounding)))


@dataclass(frozen=True, eq=False, slots=True)
class _Weight:
    """A lock's weight over the boxes where it may have one, given by their numbers (P,)."""

    places: Int
    jets: Jets

    def only(self, numbers: Int) -> _Weight:
        """Over boxes that are numbered anew, by (B,); those with -1 are left out."""
        kept = np.flatnonzero(numbers[self.places] >= 0)
        return _Weight(numbers[self.places[kept]], self.jets.only(kept))


@dataclass(frozen=True, eq=False, slots=True)
class _Boxes:
    """Boxes with the weights of every lock over them; bare ones see none, ``own`` (B,) is the lock that is whole."""

    centres: Points
    half_widths: Float
    weights: tuple[_Weight, ...]
    bare: Bool
    own: Int

    @property
    def whole(self) -> Bool:
        """Boxes in which the field is one bone's displacement."""
        found: Bool = self.own >= 0
        return found

    def only(self, kept: NDArray[np.int64]) -> _Boxes:
        numbers = np.full(len(self.centres), -1)
        numbers[kept] = np.arange(len(kept))
        weights = tuple(weight.only(numbers) for weight in self.weights)
        return _Boxes(self.centres[kept], self.half_widths[kept], weights, self.bare[kept], self.own[kept])

    def least_left(self) -> Float:
        """The least that weights of which one at most is not 0 leave of 1."""
        most = np.zeros(len(self.centres))
        for weight in self.weights:
            most[weight.places] = np.maximum(most[weight.places], weight.jets.high)
        left: Float = 1.0 - most - 1e-14
        return left

    def most_left(self) -> Float:
        """The most that they leave."""
        least = np.zeros(len(self.centres))
        for weight in self.weights:
            least[weight.places] = np.maximum(least[weight.places], weight.jets.low)
        left: Float = 1.0 - least + 1e-14
        return left


def _strain_size(matrices: Gradients) -> Float:
    """(B,) at least the largest size of the eigenvalues of the symmetric parts."""
    size: Float = 0.5 * np.linalg.norm(matrices + matrices.transpose(0, 2, 1), axis=(1, 2)) * (1.0 + 1e-13)
    return size


def _some_at_once(
    bounds: Callable[[Points, Float], tuple[Float, Float]], centres: Points, half_widths: Float
) -> tuple[Float, Float]:
    """What bounds (B, ...) and (B, ...) of boxes are, found for ``AT_ONCE`` of them at a time."""
    half_widths = np.broadcast_to(half_widths, centres.shape)
    if len(centres) <= AT_ONCE:
        return bounds(centres, half_widths)
    starts = range(0, len(centres), AT_ONCE)
    parts = [bounds(centres[k : k + AT_ONCE], half_widths[k : k + AT_ONCE]) for k in starts]
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _outside(ranges: Float, enough: tuple[float, float]) -> Bool:
    """(B,) where ranges reach beyond what is enough."""
    found: Bool = ~((ranges[:, 0] >= enough[0]) & (ranges[:, 1] <= enough[1]))
    return found


def _risen(jet: tuple[Float, Points], over: float) -> tuple[Float, Points]:
    """A smooth step of a value with its gradient: 0 up to 0, 1 from ``over`` on, level at both."""
    t = np.clip(jet[0] / over, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t), (6.0 * t * (1.0 - t) / over)[:, None] * jet[1]


def _product(a: tuple[Float, Points], b: tuple[Float, Points]) -> tuple[Float, Points]:
    return a[0] * b[0], a[0][:, None] * b[1] + b[0][:, None] * a[1]


def _times(a: Float, b: Float) -> Float:
    """Products in which nothing times infinity is nothing."""
    product: Float = np.where(b > 0.0, a * np.where(b > 0.0, b, 1.0), 0.0)
    return product


def _symmetric_range(matrix: Float) -> Float:
    values = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[[0, -1]]
    slack = ROUNDING * np.abs(matrix).sum() + 1e-280
    found: Float = values + np.array([-slack, slack])
    return found
