"""Where bones lock the field: distances around rigid bones at rest on lattices, and the weights of one step's locks.

Takes bones' surfaces and where they stand; gives `musclefit.fields.locked.WeightLattice`. Distances decide only how the
weights fade. That a weight is 1 on the bone's whole surface holds by construction: every node whose spline reaches the
surface has the value 1, unless another bone is so near that both cannot have their way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.spatial import cKDTree

from musclefit.errors import FieldError
from musclefit.fields.locked import Lock, WeightLattice
from musclefit.fields.weights import NOTHING, SIDE, WHOLE
from musclefit.geometry.arrays import Bool, Float, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surface_samples import surface_samples
from musclefit.progress import Progress, Silent

SAMPLED = 0.6
"""How far a place of a surface may be from a sample of it, in units of the lattice's spacing."""

SPLINE = 1.5
"""Half width of a spline along each axis, in units of the lattice's spacing."""

WHOLE_FROM = 1.6
"""Where another bone is farther than this times the gap in which none is locked, a bone is locked whole."""

FAR = np.float32(1e6)
"""Distance of what is out of reach, mm."""


@dataclass(frozen=True, eq=False)
class BoneDistances:
    """Distances around a group of bones at rest, on the nodes of a lattice in bricks (`musclefit.fields.weights`).

    Parameters
    ----------
    low : (3,) float64, mm
    spacing_mm : float
    bricks : (b0, b1, b2) int32
        Row of distances, or ``NOTHING`` (out of reach), or ``WHOLE`` (deep within).
    places : (R, 3) int64
        The brick of each row.
    distances : (R, 8, 8, 8) float32, mm
        Of the bricks' own nodes; 0 within the bones and wherever a node's spline reaches their surface.
    """

    low: Float
    spacing_mm: float
    bricks: NDArray[np.int32]
    places: Int
    distances: NDArray[np.float32]

    @property
    def held_mm(self) -> float:
        """Where weights begin to fade: beyond every node whose spline reaches the surface."""
        return held_mm(self.spacing_mm)

    @property
    def corners(self) -> Points:
        """(R, 3) first nodes of the rows' bricks, mm."""
        first: Points = self.low + self.places * (SIDE * self.spacing_mm)
        return first

    @classmethod
    def around(cls, surface: TriMesh, *, spacing_mm: float, known_mm: float) -> BoneDistances:
        """Of the bones that closed surfaces bound.

        Parameters
        ----------
        surface : TriMesh
        spacing_mm : float
            Of the lattice's nodes.
        known_mm : float
            Distances are known this far from the surface, within the bones, too.
        """
        h, side = spacing_mm, SIDE * spacing_mm
        samples = surface_samples(surface, spacing_mm=SAMPLED * h)
        # 1e-6: what rounding adds to a node's place in units of the spacing.
        seals = SPLINE + samples.gap_mm / h + 1e-6
        reach = max(known_mm, np.sqrt(3.0) * seals * h) + 2.0 * h
        low = np.floor((surface.vertices.min(axis=0) - reach) / side) * side + 0.5 * h
        shape = np.ceil((surface.vertices.max(axis=0) + reach - low) / side).astype(np.int64) + 1
        near = _bricks_near(samples.points, low, h, shape, reach)
        bricks = np.full(tuple(shape), NOTHING, dtype=np.int32)
        bricks[tuple(near.T)] = np.arange(len(near))
        bricks[_inside(samples.points, low, side, shape) & (bricks == NOTHING)] = WHOLE
        inner = np.empty((len(near), SIDE, SIDE, SIDE), dtype=np.float32)
        _propagate(near, low, h, samples.points, *_coarse(samples.points, near, low, side), inner)
        _seal(samples.points, low, h, bricks, seals, inner)
        outside = np.zeros(inner.shape, dtype=np.bool_)
        _flood(bricks, inner > 0.0, outside, near)
        inner[~outside] = 0.0
        return cls(low, h, bricks, near, inner)


def held_mm(spacing_mm: float) -> float:
    """How far from a surface a node may be whose spline reaches it, at most, mm."""
    return float(np.sqrt(3.0)) * (SPLINE + SAMPLED) * spacing_mm


def _bricks_near(samples: Points, low: Float, h: float, shape: Int, reach: float) -> Int:
    """Indices (R, 3) of the bricks that have a node within reach of a sample, and of some more."""
    side, half = SIDE * h, 0.5 * (SIDE - 1) * h
    own = np.unique(np.floor((samples - low) / side + 0.5 / SIDE).astype(np.int64), axis=0)
    span = int(np.ceil(reach / side)) + 1
    steps = np.stack(np.meshgrid(*[np.arange(-span, span + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    seen = np.zeros(tuple(shape), dtype=bool)
    for step in steps:
        moved = own + step
        kept = ((moved >= 0) & (moved < shape)).all(axis=1)
        seen[tuple(moved[kept].T)] = True
    candidates = np.argwhere(seen)
    limit = reach + np.sqrt(3.0) * half
    distances = cKDTree(samples).query(low + candidates * side + half, distance_upper_bound=1.01 * limit)[0]
    found: Int = candidates[distances <= limit]
    return found


def _coarse(samples: Points, near: Int, low: Float, side: float) -> tuple[Int, Int]:
    """For every brick the numbers (R, 27) of the samples nearest to its corners, its centre and what is half way."""
    steps = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    places = (2 * near[:, None, :] + steps).reshape(-1, 3)
    unique, inverse = np.unique(places, axis=0, return_inverse=True)
    nearest = cKDTree(samples).query(low + unique * (0.5 * side), workers=2)[1]
    return np.asarray(nearest, dtype=np.int64)[inverse].reshape(-1, 27), steps


@njit(parallel=True, cache=True)
def _propagate(near, low, h, samples, nearest, steps, inner):
    """Distances of nodes to the nearest of the samples that are nearest to their brick's own 27 places."""
    side = inner.shape[1]
    for row in prange(len(near)):
        for i in range(side):
            for j in range(side):
                for k in range(side):
                    x = low[0] + (near[row, 0] * side + i) * h
                    y = low[1] + (near[row, 1] * side + j) * h
                    z = low[2] + (near[row, 2] * side + k) * h
                    best = 1e30
                    for corner in range(27):
                        if abs(2 * i - side * steps[corner, 0]) > side:
                            continue
                        if abs(2 * j - side * steps[corner, 1]) > side or abs(2 * k - side * steps[corner, 2]) > side:
                            continue
                        s = nearest[row, corner]
                        dx, dy, dz = x - samples[s, 0], y - samples[s, 1], z - samples[s, 2]
                        best = min(best, dx * dx + dy * dy + dz * dz)
                    inner[row, i, j, k] = np.float32(np.sqrt(best))


@njit(cache=True)
def _seal(samples, low, h, bricks, seals, inner):
    """Write 0 at every node within ``seals`` spacings of a sample along each axis: all bricks there have rows."""
    first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for s in range(len(samples)):
        for axis in range(3):
            u = (samples[s, axis] - low[axis]) / h
            first[axis], last[axis] = int(np.ceil(u - seals)), int(np.floor(u + seals))
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                for k in range(first[2], last[2] + 1):
                    row = bricks[i // SIDE, j // SIDE, k // SIDE]
                    if row < 0:
                        raise IndexError("a node beside the surface is in no brick near it")
                    inner[row, i % SIDE, j % SIDE, k % SIDE] = np.float32(0.0)


def _inside(samples: Points, low: Float, side: float, shape: Int) -> Bool:
    """Bricks that no surface goes through and that cannot be left without crossing one."""
    crossed = np.zeros(tuple(shape), dtype=bool)
    for step in np.ndindex(2, 2, 2):
        shifted = np.floor((samples - low) / side + (np.array(step) - 0.5) * 0.2).astype(np.int64)
        crossed[tuple(np.clip(shifted, 0, shape - 1).T)] = True
    parts, _ = label(~crossed)
    outside = np.unique(np.concatenate([parts[index].ravel() for k in range(3) for index in _faces(k)]))
    inside: Bool = (parts > 0) & ~np.isin(parts, outside)
    return inside


def _faces(axis: int) -> tuple[tuple[int | slice, ...], tuple[int | slice, ...]]:
    whole: list[int | slice] = [slice(None)] * 3
    first, last = list(whole), list(whole)
    first[axis], last[axis] = 0, -1
    return tuple(first), tuple(last)


@njit(inline="always")
def _beside(a, b, c, axis, way):
    """One step along an axis."""
    return a + (way if axis == 0 else 0), b + (way if axis == 1 else 0), c + (way if axis == 2 else 0)


@njit(cache=True)
def _flood(bricks, free, outside, places):
    """Mark the free nodes that are joined to bricks out of reach, or to the lattice's border."""
    stack = [(np.int64(0), np.int64(0), np.int64(0))]
    stack.pop()
    shape = (bricks.shape[0] * SIDE, bricks.shape[1] * SIDE, bricks.shape[2] * SIDE)
    for row in range(len(places)):
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    if (SIDE - 1 > i > 0 and SIDE - 1 > j > 0 and SIDE - 1 > k > 0) or not free[row, i, j, k]:
                        continue
                    x, y, z = places[row, 0] * SIDE + i, places[row, 1] * SIDE + j, places[row, 2] * SIDE + k
                    for axis in range(3):
                        for way in (-1, 1):
                            a, b, c = _beside(x, y, z, axis, way)
                            beyond = not (0 <= a < shape[0] and 0 <= b < shape[1] and 0 <= c < shape[2])
                            beyond = beyond or bricks[a // SIDE, b // SIDE, c // SIDE] == -1
                            if beyond and not outside[row, i, j, k]:
                                outside[row, i, j, k] = True
                                stack.append((x, y, z))
    while len(stack):
        x, y, z = stack.pop()
        for axis in range(3):
            for way in (-1, 1):
                a, b, c = _beside(x, y, z, axis, way)
                if not (0 <= a < shape[0] and 0 <= b < shape[1] and 0 <= c < shape[2]):
                    continue
                row, i, j, k = bricks[a // SIDE, b // SIDE, c // SIDE], a % SIDE, b % SIDE, c % SIDE
                if row >= 0 and free[row, i, j, k] and not outside[row, i, j, k]:
                    outside[row, i, j, k] = True
                    stack.append((a, b, c))


@njit(inline="always")
def _smooth(t):
    """From 1 at 0 down to 0 at 1, level at both ends."""
    t = min(max(t, 0.0), 1.0)
    return 1.0 - t * t * (3.0 - 2.0 * t)


@dataclass(frozen=True, eq=False, slots=True)
class Stand:
    """Where a group of bones stands: x -> linear x + translation, from rest."""

    linear: Float
    translation: Float

    @classmethod
    def of(cls, motion: RigidMotion) -> Stand:
        """Where a rigid motion takes it."""
        return cls(np.asarray(motion.rotation), np.asarray(motion.translation))

    def half_way(self, other: Stand) -> Stand:
        """The middle of every point's straight way to another stand."""
        return Stand(0.5 * (self.linear + other.linear), 0.5 * (self.translation + other.translation))

    def __call__(self, points: Points) -> Points:
        """Move (N, 3) points."""
        moved: Points = points @ self.linear.T + self.translation
        return moved


@dataclass(frozen=True, eq=False, slots=True)
class BoneLocks:
    """What locks groups of bones, prepared at rest once for all steps.

    Parameters
    ----------
    distances : tuple of BoneDistances
        Around each group.
    fade_mm : float
        Where weights have faded.
    gap_mm : float
        Where two groups come closer than this, neither is locked; from ``WHOLE_FROM`` times as far both are, whole.
    """

    distances: tuple[BoneDistances, ...]
    fade_mm: float
    gap_mm: float

    @classmethod
    def around(
        cls,
        surfaces: Sequence[TriMesh],
        *,
        spacing_mm: float,
        fade_mm: float,
        gap_mm: float,
        progress: Progress | None = None,
    ) -> BoneLocks:
        """Of the groups that closed surfaces at rest bound.

        Raises
        ------
        FieldError
            A spacing too wide for weights to fade in the length, or for two groups to be locked beyond the gap.
        """
        held = held_mm(spacing_mm)
        if not (fade_mm > held and gap_mm >= 2.0 * held):
            raise FieldError(
                f"locks on a lattice of {spacing_mm:.3g} mm hold the field to {held:.3g} mm from bone; found a fade of "
                f"{fade_mm:.3g} mm, expected more, and a gap of {gap_mm:.3g} mm, expected at least twice that; take a "
                "narrower lattice"
            )
        known = max(fade_mm, WHOLE_FROM * gap_mm)
        found = []
        with (progress or Silent()).stage("distances around bones") as tick:
            for surface in surfaces:
                found.append(BoneDistances.around(surface, spacing_mm=spacing_mm, known_mm=known))
                tick(len(found) / len(surfaces))
        return cls(tuple(found), fade_mm, gap_mm)

    def of_step(self, before: Sequence[Stand], after: Sequence[Stand]) -> tuple[Lock, ...]:
        """The locks of a Cayley step from one stand of every group to another.

        Raises
        ------
        FieldError
            A group turns by about 180 degrees.
        """
        middles = [a.half_way(b) for a, b in zip(before, after, strict=True)]
        return tuple(
            Lock.of_step(self._weights(k, middles), (a.linear, a.translation), (b.linear, b.translation))
            for k, (a, b) in enumerate(zip(before, after, strict=True))
        )

    def _weights(self, k: int, stands: Sequence[Stand]) -> WeightLattice:
        """The weights of one group where all stand as they do."""
        own = self.distances[k]
        squares = np.zeros(own.distances.shape)
        nearest = np.full(own.distances.shape, np.float64(FAR))
        for j, other in enumerate(self.distances):
            if j == k:
                continue
            back = np.linalg.inv(stands[j].linear)
            linear = back @ stands[k].linear
            shift = back @ (stands[k].translation - stands[j].translation)
            near = _known_by(other, own.corners @ linear.T + shift, SIDE * own.spacing_mm)
            _add_other(
                near,
                own.corners,
                own.spacing_mm,
                linear,
                shift,
                other.low,
                other.spacing_mm,
                other.bricks,
                other.distances,
                other.held_mm,
                squares,
                nearest,
            )
        values = np.empty(own.distances.shape, dtype=np.uint16)
        _write_weights(own.distances, squares, nearest, own.held_mm, self.fade_mm, self.gap_mm, values)
        return WeightLattice.of(own.low, own.spacing_mm, bricks=own.bricks, places=own.places, inner=values)


def _known_by(other: BoneDistances, corners: Points, side: float) -> Int:
    """Rows of the cubes, of one corner (R, 3) in the other's frame and a side, that may see a distance it knows."""
    own_side = SIDE * other.spacing_mm
    span = int(np.ceil(np.sqrt(3.0) * side / own_side)) + 1
    index = np.floor((corners - other.low) / own_side).astype(np.int64)
    known = _dilated(other.bricks != NOTHING, span)
    kept = np.flatnonzero(((index >= -span) & (index < np.array(other.bricks.shape) + span)).all(axis=1))
    found: Int = kept[known[tuple((index[kept] + span).T)]]
    return found


def _dilated(seen: Bool, span: int) -> Bool:
    """Grown by a number of cells along every axis, in an array that is larger by as many on every side."""
    grown = np.pad(seen, span)
    for axis in range(3):
        whole = grown.copy()
        for step in range(1, span + 1):
            whole |= np.roll(grown, step, axis=axis) | np.roll(grown, -step, axis=axis)
        grown = whole
    return grown


@njit(inline="always")
def _distance_at(low, h, bricks, distances, x, y, z):
    """Distance at a place of the lattice's frame, between its nodes; far where it is not known."""
    u, v, w = (x - low[0]) / h, (y - low[1]) / h, (z - low[2]) / h
    i, j, k = int(np.floor(u)), int(np.floor(v)), int(np.floor(w))
    u, v, w = u - i, v - j, w - k
    total = 0.0
    for p in range(2):
        for q in range(2):
            for r in range(2):
                a, b, c = i + p, j + q, k + r
                if not (
                    0 <= a < bricks.shape[0] * SIDE
                    and 0 <= b < bricks.shape[1] * SIDE
                    and 0 <= c < bricks.shape[2] * SIDE
                ):
                    return 1e6
                row = bricks[a // SIDE, b // SIDE, c // SIDE]
                if row == -1:
                    return 1e6
                if row >= 0:
                    share = (u if p else 1.0 - u) * (v if q else 1.0 - v) * (w if r else 1.0 - w)
                    total += share * distances[row, a % SIDE, b % SIDE, c % SIDE]
    return total


@njit(parallel=True, cache=True)
def _add_other(rows, corners, h, linear, shift, low, spacing, bricks, distances, held, squares, nearest):
    for number in prange(len(rows)):
        row = rows[number]
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    x, y, z = corners[row, 0] + i * h, corners[row, 1] + j * h, corners[row, 2] + k * h
                    d = _distance_at(
                        low,
                        spacing,
                        bricks,
                        distances,
                        linear[0, 0] * x + linear[0, 1] * y + linear[0, 2] * z + shift[0],
                        linear[1, 0] * x + linear[1, 1] * y + linear[1, 2] * z + shift[1],
                        linear[2, 0] * x + linear[2, 1] * y + linear[2, 2] * z + shift[2],
                    )
                    if d < 1e5:
                        free = max(d - held, 1e-3)
                        squares[row, i, j, k] += 1.0 / (free * free)
                        nearest[row, i, j, k] = min(nearest[row, i, j, k], d)


@njit(parallel=True, cache=True)
def _write_weights(distances, squares, nearest, held, fade, gap, values):
    """Faded with distance, shared with other groups by distance, and none in a gap too narrow for both."""
    for row in prange(distances.shape[0]):
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    d = distances[row, i, j, k]
                    w = _smooth((d - held) / (fade - held))
                    if nearest[row, i, j, k] < 1e5 and w > 0.0:
                        free = max(d - held, 0.0)
                        w *= 1.0 / (1.0 + free * free * squares[row, i, j, k])
                        w *= 1.0 - _smooth((d + nearest[row, i, j, k] - gap) / ((WHOLE_FROM - 1.0) * gap))
                    values[row, i, j, k] = np.uint16(65535.0 * w)
