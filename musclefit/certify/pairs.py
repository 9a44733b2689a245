r"""Proves that a field's map is one-to-one on a region of any shape, where it need not be monotone: pair by pair.

It takes a field D and factors s, and shows of every U = id + s D that U(x) = U(y) for no two points of the region.

**Near pairs.** U(x) - U(y) = M (x - y) with M the mean of I + s grad D on the segment between them. On a convex box
whose gradients all lie within r of a matrix G in the spectral norm, M lies within |s| r of I + s G, since balls of
matrices are convex; so no two points of the box come together where the smallest singular value of I + s G exceeds
|s| r. Rotation, which costs monotonicity, costs nothing here. The region is covered with small boxes such that this
holds for `REACH` times the box: every point of it against every point within that.

**Far pairs.** The images of two boxes are kept apart. By a linear functional p (a row of the inverse of I + s G):
p . U over a box of half widths h around c differs from p . U(c) by at most |p^T (I + s G)| . h + |p| |s| r |h|. Where
no such row parts them, the box around both may itself be one on which near pairs are told apart; else the larger of
the two is cut.

**Where the gradient jumps** at a single place, `jumps` tells near pairs apart on boxes around it.

The sign of the determinant is that at the centre, on the whole of every box. Singular values and products are
taken with room for their rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from musclefit.certify.ball_covers import displacement_with_error
from musclefit.certify.jumps import least_singular_at_jumps
from musclefit.certify.regions import Region
from musclefit.compiling import njit
from musclefit.fields.protocol import Field
from musclefit.geometry.arrays import Bool, Float, Gradients, Int, Points

FIRST_BOXES = 400
"""Boxes that a region's bounding box is cut into at first."""

REACH = 2.0
"""Half widths of the box around a box on which near pairs are told apart, in its own."""

SPARE = 1.25
"""Smallest singular value over the radius of the gradients, at least, of a box that is cut no further."""

CUT_TWICE, CUT_THRICE = 1.3, 1.7
"""How much a box must lack to be halved along two sides, or three."""

SMALLEST = 1e-5
"""Of the region's extent: boxes this narrow are not cut further."""

AT_LIMIT = 1e-9
"""Singular values up to this are told from none by no number of boxes."""

ROUNDING = 1e-12
"""Of the size of matrices and coordinates: what singular values, products and sums of them may be off, and more."""

GRAIN = 32
"""Parts of a cube's side on whose multiples its corners lie, and steps between a size and its double."""

PAIRS_PER_BOX = 40
"""Of the budget of boxes: how many pairs of boxes may be looked at."""

CHUNK = 1 << 17
"""Pairs that are looked at at once."""


@dataclass(frozen=True, eq=False, slots=True)
class PairProof:
    """What was found.

    Parameters
    ----------
    margin : float
        Where positive, U is proved one-to-one and keeps orientation for every factor, and every singular value of
        every I + s grad D is proved to be at least this.
    sampled_margin : float
        The smallest singular value at centres of boxes; below 0 where orientation is reversed at one.
    place : (n,) float64, mm
        Where that is.
    examined, left : int
        Boxes evaluated, and boxes or pairs left unproved.
    ended : str
        Why there is no proof; empty where there is one.
    """

    margin: float
    sampled_margin: float
    place: Points
    examined: int
    left: int
    ended: str


@dataclass(frozen=True, eq=False, slots=True)
class _Boxes:
    """Boxes with the gradients over ``REACH`` times them: within ``radii`` (B,) of ``gradients`` (B, n, n)."""

    centres: Points
    halves: Float
    gradients: Gradients
    radii: Float

    def __len__(self) -> int:
        return len(self.centres)

    def only(self, kept: Bool | Int) -> _Boxes:
        return _Boxes(self.centres[kept], self.halves[kept], self.gradients[kept], self.radii[kept])

    def joined(self, other: _Boxes) -> _Boxes:
        return _Boxes(
            np.concatenate([self.centres, other.centres]),
            np.concatenate([self.halves, other.halves]),
            np.concatenate([self.gradients, other.gradients]),
            np.concatenate([self.radii, other.radii]),
        )


class _Search:
    """Its boxes are cut until near pairs are told apart on all of them, then until far pairs are."""

    def __init__(self, field: Field, factors: Sequence[float], region: Region, max_boxes: int) -> None:
        self.field, self.factors, self.region, self.max_boxes = field, factors, region, max_boxes
        self.examined, self.pairs = 0, 0
        self.margin, self.sampled = np.inf, np.inf
        self.place = np.full(len(region.low), np.nan)
        self.extent = region.edge * max(region.inside.shape)
        self.slack = ROUNDING * float(np.abs([region.low, region.low + self.extent]).max())

    def evaluated(self, centres: Points, halves: Float) -> _Boxes:
        """Boxes with their gradients."""
        self.examined += len(centres)
        gradients, radii = self.field.gradient_bounds(centres, REACH * halves * (1.0 + 1e-9) + self.slack)
        return _Boxes(centres, halves, gradients, radii)

    def near(self, tick: Callable[[float], None]) -> tuple[_Boxes, str]:
        """Boxes that cover the region, near pairs told apart on each; or why that is not reached."""
        centres, halves = self.region.boxes(FIRST_BOXES)
        done = [self.evaluated(centres[:0], halves[:0])]
        while len(centres):
            if self.examined + len(centres) > self.max_boxes:
                return _joined(done), f"the budget of boxes is spent: {len(centres)} more were to be examined"
            boxes = self.evaluated(centres, halves)
            least, lacks = self._least(boxes)
            fits = lacks <= 1.0
            if self.sampled < AT_LIMIT:
                return _joined(done), (
                    f"the map collapses or reverses orientation in the domain around the body, at "
                    f"{np.array2string(self.place, precision=4)} mm (signed singular value {self.sampled:.2g})"
                )
            self.margin = min(self.margin, float(least[fits].min(initial=np.inf)))
            done.append(boxes.only(fits))
            boxes, lacks = boxes.only(~fits), lacks[~fits]
            if (boxes.halves.max(axis=1) < SMALLEST * self.extent).any():
                return _joined(done), (
                    f"boxes of {SMALLEST:g} of the domain's extent are not proved: the gradient is too steep or jumps "
                    "there"
                )
            parts = [
                self._cut(boxes.centres[chosen], boxes.halves[chosen], axes)
                for axes, chosen in enumerate(_by_lack(lacks, boxes.centres.shape[1]), start=1)
            ]
            centres, halves = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
            tick(min(1.0, self.examined / self.max_boxes))
        return _joined(done), ""

    def _least(self, boxes: _Boxes) -> tuple[Float, Float]:
        """(B,) proved lower bounds of singular values, and how far boxes are from sufficing; keeps the worst sample.

        Boxes that lack no more than 1 are cut no further.
        """
        least, lacks = np.full(len(boxes), np.inf), np.zeros(len(boxes))
        within = self.region.meets(boxes.centres, np.zeros_like(boxes.centres))
        for s in self.factors:
            matrices = _matrices(boxes.gradients, s)
            singular = _least_singular(matrices)
            signed = np.where(np.linalg.det(matrices) > 0.0, singular, -singular)
            own = signed - abs(s) * boxes.radii
            lack = np.divide(SPARE * abs(s) * boxes.radii, signed, out=np.full(len(boxes), np.inf), where=signed > 0.0)
            lack = np.nan_to_num(lack, nan=np.inf)
            short = np.flatnonzero(lack > 1.0)
            own[short], lack[short] = self._at_jumps(boxes.only(short), s, own[short], lack[short])
            least = np.minimum(least, np.nan_to_num(own, nan=-np.inf))
            lacks = np.maximum(lacks, lack)
            judged = np.where(within & ~np.isnan(signed), signed, np.inf)
            # The middle of an enclosure is no gradient: what seems to collapse is looked at itself.
            low = np.flatnonzero(judged < AT_LIMIT)
            itself = _matrices(self.field.gradient(boxes.centres[low]), s)
            judged[low] = np.nan_to_num(np.sign(np.linalg.det(itself)) * _least_singular(itself), nan=np.inf)
            worst = int(np.argmin(judged)) if len(judged) else -1
            if worst >= 0 and judged[worst] < self.sampled:
                self.sampled, self.place = float(judged[worst]), boxes.centres[worst]
        return least, lacks

    def _at_jumps(self, boxes: _Boxes, s: float, least: Float, lacks: Float) -> tuple[Float, Float]:
        """The same where a jump of the gradient at a single place is told apart, where that is better."""
        halves = REACH * boxes.halves * (1.0 + 1e-9) + self.slack
        values, off = least_singular_at_jumps(self.field, s, boxes.centres, halves)
        lack = np.divide(SPARE * off, values, out=np.full(len(boxes), np.inf), where=values > 0.0)
        better = lack < lacks
        return np.where(better, values - off, least), np.where(better, lack, lacks)

    def _cut(self, centres: Points, halves: Float, axes: int) -> tuple[Points, Float, Int]:
        """Halves along so many of the longest sides that meet the region, and (C,) the numbers of what they are of."""
        signs = 2.0 * np.array(list(np.ndindex(*(2,) * axes))) - 1.0
        order = np.argsort(-halves, axis=1, kind="stable")[:, :axes]
        half = halves.copy()
        np.put_along_axis(half, order, 0.5 * np.take_along_axis(half, order, axis=1), axis=1)
        children, half = np.repeat(centres, len(signs), axis=0), np.repeat(half, len(signs), axis=0)
        parents = np.repeat(np.arange(len(centres)), len(signs))
        moved = np.take_along_axis(half, order[parents], axis=1) * np.tile(signs, (len(centres), 1))
        np.put_along_axis(
            children, order[parents], np.take_along_axis(children, order[parents], axis=1) + moved, axis=1
        )
        half = half + self.slack
        kept = self.region.meets(children, half)
        return children[kept], half[kept], parents[kept]

    def far(self, boxes: _Boxes, s: float) -> tuple[int, str]:
        """Far pairs under one factor: how many are left, and why."""
        values, errors = self._images(boxes.centres, s)
        most = PAIRS_PER_BOX * self.max_boxes - self.pairs
        waiting, count = _close_images(boxes, values, errors, s, most)
        if count > most:
            return count, f"the budget of pairs is spent: {count} pairs of {len(boxes)} boxes are close to each other"
        while len(waiting):
            self.pairs += len(waiting)
            if self.pairs > PAIRS_PER_BOX * self.max_boxes:
                return len(waiting), f"the budget of pairs is spent: {len(waiting)} more were to be told apart"
            open_pairs = []
            for start in range(0, len(waiting), CHUNK):
                chunk = waiting[start : start + CHUNK]
                open_pairs.append(chunk[~_told_apart(boxes, values, errors, s, chunk)])
            waiting = np.concatenate(open_pairs)
            if not len(waiting):
                break
            if self.examined > self.max_boxes:
                return len(waiting), f"the budget of boxes is spent: {len(waiting)} more pairs were to be told apart"
            waiting = waiting[~self._as_one(boxes, s, waiting)]
            larger = np.where(boxes.halves[waiting[:, 0]].max(axis=1) >= boxes.halves[waiting[:, 1]].max(axis=1), 0, 1)
            rows = np.arange(len(waiting))
            cut, other = waiting[rows, larger], waiting[rows, 1 - larger]
            parents, of_pair = np.unique(cut, return_inverse=True)
            if (boxes.halves[parents].max(axis=1, initial=0.0) < SMALLEST * self.extent).any():
                return len(waiting), "places apart from each other are not seen to stay so: their images meet or nearly"
            centres, halves, of_parent = self._cut(
                boxes.centres[parents], boxes.halves[parents], boxes.centres.shape[1]
            )
            if self.examined + len(centres) > self.max_boxes:
                return len(waiting), f"the budget of boxes is spent: {len(waiting)} more pairs were to be told apart"
            first = len(boxes)
            boxes = boxes.joined(self.evaluated(centres, halves))
            more, off = self._images(centres, s)
            values, errors = np.concatenate([values, more]), np.concatenate([errors, off])
            waiting = _pairs_of_children(of_parent, of_pair, other, first)
        return 0, ""

    def _images(self, centres: Points, s: float) -> tuple[Points, Float]:
        values, errors = displacement_with_error(self.field, centres)
        return centres + s * values, abs(s) * errors + self.slack + ROUNDING * np.abs(values).sum(axis=1)

    def _as_one(self, boxes: _Boxes, s: float, pairs: Int) -> Bool:
        """(P,) whether near pairs are told apart on a cube around both, or on the box around both.

        The cubes have their corners on a grid, so that many pairs of neighbours share one.
        """
        a, b = pairs.T
        low = np.minimum(boxes.centres[a] - boxes.halves[a], boxes.centres[b] - boxes.halves[b])
        high = np.maximum(boxes.centres[a] + boxes.halves[a], boxes.centres[b] + boxes.halves[b])
        size = np.ceil(np.log2((high - low).max(axis=1) / self.extent) * GRAIN).astype(int)
        side = self.extent * 2.0 ** (size / GRAIN)
        corner = np.round((low - self.region.low) / side[:, None] * GRAIN).astype(int)
        cubes, of_pair = np.unique(np.column_stack([size, corner]), axis=0, return_inverse=True)
        side = self.extent * 2.0 ** (cubes[:, :1] / GRAIN)
        middles = self.region.low + side * (cubes[:, 1:] / GRAIN + 0.5)
        halves = np.repeat(0.5 * side * (1.0 + 1.0 / GRAIN), middles.shape[1], axis=1)
        one = self._convex(middles, halves, s)[of_pair.ravel()]
        left = np.flatnonzero(~one)
        one[left] = self._convex(0.5 * (low[left] + high[left]), 0.5 * (high[left] - low[left]), s)
        return one

    def _convex(self, centres: Points, halves: Float, s: float) -> Bool:
        """(B,) boxes of which no two points come together, by their gradients alone."""
        self.examined += len(centres)
        halves = halves * (1.0 + 1e-9) + self.slack
        gradients, radii = self.field.gradient_bounds(centres, halves)
        one: Bool = _least_singular(_matrices(gradients, s)) > abs(s) * radii
        left = np.flatnonzero(~one)
        values, off = least_singular_at_jumps(self.field, s, centres[left], halves[left])
        one[left] = values > off
        return one


def prove_one_to_one(
    field: Field, factors: Sequence[float], region: Region, *, max_boxes: int, tick: Callable[[float], None]
) -> PairProof:
    """Prove that id + s D is one-to-one on a region and keeps orientation there, for every factor s.

    Parameters
    ----------
    field : Field
        D.
    factors : sequence of float
    region : Region
    max_boxes : int
        Boxes that may be evaluated; with it goes the number of pairs (``PAIRS_PER_BOX``).
    tick : callable
        Is told the share of the budget used.
    """
    search = _Search(field, factors, region, max_boxes)
    boxes, ended = search.near(tick)
    left = 1 if ended else 0
    for s in factors:
        if ended:
            break
        left, ended = search.far(boxes, s)
    margin = -np.inf if ended else search.margin
    return PairProof(margin, search.sampled, search.place, search.examined, left, ended)


def _by_lack(lacks: Float, n: int) -> list[Int]:
    """Which boxes are to be halved along one, two, ... n sides, by how much they lack."""
    axes = np.minimum(1 + (lacks > CUT_TWICE).astype(int) + (lacks > CUT_THRICE), n)
    return [np.flatnonzero(axes == k) for k in range(1, n + 1)]


def _joined(parts: Sequence[_Boxes]) -> _Boxes:
    whole = parts[0]
    for part in parts[1:]:
        whole = whole.joined(part)
    return whole


def _matrices(gradients: Gradients, s: float) -> Gradients:
    """I + s G; NaN as a whole where an entry is not a number."""
    matrices: Gradients = np.eye(gradients.shape[-1]) + s * gradients
    matrices[~(np.abs(matrices).max(axis=(1, 2), initial=0.0) < 1e100)] = np.nan
    return matrices


def _least_singular(matrices: Gradients) -> Float:
    """(B,) smallest singular values, rounded down; NaN where entries are not numbers."""
    known = np.isfinite(matrices).all(axis=(1, 2))
    least = np.full(len(matrices), np.nan)
    values = np.linalg.svd(matrices[known], compute_uv=False)
    least[known] = values[:, -1] - ROUNDING * values[:, 0]
    return least


def _close_images(boxes: _Boxes, values: Points, errors: Float, s: float, most: int) -> tuple[Int, int]:
    """(P, 2) pairs of boxes whose images are not seen apart by the balls around them, by size class of those.

    Gives none, and how many there may be, where that is more than ``most``.
    """
    balls = _image_radii(boxes, s) + errors
    order = np.argsort(balls)
    classes = [part for part in np.split(order, np.searchsorted(balls[order], _doubled(balls))) if len(part)]
    trees = [cKDTree(values[part]) for part in classes]
    found, count = [], 0
    for i, part in enumerate(classes):
        widest = float(balls[part].max())
        count += int(trees[i].count_neighbors(trees[i], 2.0 * widest) - len(part)) // 2
        count += sum(int(trees[i].count_neighbors(trees[j], widest + float(balls[classes[j]].max()))) for j in range(i))
        if count > 4 * most:
            return np.zeros((0, 2), dtype=np.int64), count
        near = trees[i].query_pairs(2.0 * widest, output_type="ndarray")
        found.append(np.stack([part[near[:, 0]], part[near[:, 1]]], axis=1))
        for j in range(i):
            apart = trees[i].sparse_distance_matrix(
                trees[j], widest + float(balls[classes[j]].max()), output_type="ndarray"
            )
            found.append(np.stack([part[apart["i"]], classes[j][apart["j"]]], axis=1))
    pairs = np.concatenate(found)
    a, b = pairs.T
    kept = []
    for start in range(0, len(pairs), CHUNK):
        rows = slice(start, start + CHUNK)
        apart = np.linalg.norm(values[a[rows]] - values[b[rows]], axis=1)
        kept.append(apart * (1.0 - ROUNDING) <= balls[a[rows]] + balls[b[rows]])
    pairs = pairs[np.concatenate(kept)] if kept else pairs
    return pairs, len(pairs)


def _doubled(sizes: Float) -> Float:
    """Sizes from the smallest to the largest, each twice the one before."""
    low, high = float(sizes.min()), float(sizes.max())
    count = int(np.ceil(np.log2(max(high / max(low, 1e-300), 1.0))))
    return np.asarray(low * 2.0 ** np.arange(1, min(count, 64) + 1), dtype=np.float64)


def _image_radii(boxes: _Boxes, s: float) -> Float:
    """(B,) of balls around the images of the centres that hold the images of the boxes."""
    steep = np.linalg.norm(_matrices(boxes.gradients, s), 2, axis=(1, 2)) + abs(s) * boxes.radii
    radii: Float = steep * np.linalg.norm(boxes.halves, axis=1) * (1.0 + ROUNDING)
    return radii


def _told_apart(boxes: _Boxes, values: Points, errors: Float, s: float, pairs: Int) -> Bool:
    """(P,) pairs that are within reach of each other, or whose images a linear functional parts.

    A box within the reach of another is so by less than what reaches were enlarged by. The functionals are the rows of
    the inverses of I + s G of both boxes.
    """
    matrices = _matrices(boxes.gradients, s)
    known = np.isfinite(matrices).all(axis=(1, 2))
    inverses = np.full_like(matrices, np.nan)
    inverses[known] = np.linalg.inv(matrices[known])
    loose = abs(s) * boxes.radii + ROUNDING * np.linalg.norm(matrices, axis=(1, 2))
    loose *= np.linalg.norm(boxes.halves, axis=1) * (1.0 + ROUNDING)
    told = np.zeros(len(pairs), dtype=np.bool_)
    _tell_apart(boxes.centres, boxes.halves, values, errors, matrices, inverses, loose, pairs, told)
    return told


@njit(cache=True)
def _tell_apart(
    centres: Points,
    halves: Float,
    values: Points,
    errors: Float,
    matrices: Gradients,
    inverses: Gradients,
    loose: Float,
    pairs: Int,
    told: Bool,
) -> None:
    n = centres.shape[1]
    for p in range(len(pairs)):
        for turned in range(2):
            a, b = pairs[p, turned], pairs[p, 1 - turned]
            within = True
            for k in range(n):
                reach = abs(centres[a, k] - centres[b, k]) + halves[b, k]
                within = within and reach <= REACH * halves[a, k] * (1.0 + 1e-10)
            told[p] = told[p] or within
            for i in range(n):
                if told[p]:
                    break
                apart, size, length = 0.0, 0.0, 0.0
                for j in range(n):
                    term = inverses[a, i, j] * (values[a, j] - values[b, j])
                    apart += term
                    size += abs(term)
                    length += inverses[a, i, j] ** 2
                wide = np.sqrt(length) * (errors[a] + errors[b] + loose[a] + loose[b])
                for j in range(n):
                    own, other = 0.0, 0.0
                    for k in range(n):
                        own += inverses[a, i, k] * matrices[a, k, j]
                        other += inverses[a, i, k] * matrices[b, k, j]
                    wide += abs(own) * halves[a, j] + abs(other) * halves[b, j]
                told[p] = abs(apart) > wide * (1.0 + ROUNDING) + ROUNDING * size


def _pairs_of_children(of_parent: Int, of_pair: Int, other: Int, first: int) -> Int:
    """Pairs of the children of parents, numbered from ``first``, with what each pair's parent was to be parted from."""
    order = np.argsort(of_parent, kind="stable")
    counts = np.bincount(of_parent, minlength=int(of_pair.max(initial=-1)) + 1)
    starts = np.cumsum(counts) - counts
    per_pair = counts[of_pair]
    rows = np.repeat(np.arange(len(of_pair)), per_pair)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(per_pair) - per_pair, per_pair)
    children = first + order[starts[of_pair[rows]] + within]
    return np.stack([children, other[rows]], axis=1)
