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

from musclefit.fields.locked import Lock, WeightLattice
from musclefit.fields.weights import ACROSS, NOTHING, SIDE, WHOLE
from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion

SAMPLED = 0.7
"""Spacing of the samples of a surface that distances are taken to, in units of the lattice's spacing."""

THINNED = 3.0
"""The same, of those that distances are taken to; near the surface `SEALS` decides."""

SEES = 2.65
"""Nodes this near a sample, in units of the spacing, may have splines that reach the surface: the half width 3/2 of a
spline along each axis, times the root of 3, and the samples' own spacing."""

SEALS = 1.95
"""Nodes this near a sample along every axis, in units of the spacing, have the weight 1: the half width 3/2 of a spline
and what the samples leave between them."""

FAR = np.float32(1e6)
"""Distance of what is out of reach, mm."""


@dataclass(frozen=True, eq=False)
class BoneDistances:
    """Distances around a group of bones at rest, on the nodes of a lattice in bricks.

    Parameters
    ----------
    low : (3,) float64, mm
    spacing_mm : float
    bricks : (b0, b1, b2) int32
        Row of distances, or ``NOTHING`` (out of reach), or ``WHOLE`` (deep within).
    distances : (R, 1000) float32, mm
        0 within the bones; laid out as the values of `musclefit.fields.weights`.
    fade_mm : float
        Where weights have faded.
    """

    low: Float
    spacing_mm: float
    bricks: NDArray[np.int32]
    distances: NDArray[np.float32]
    fade_mm: float

    @property
    def sees_mm(self) -> float:
        """Nodes within this of the surface have splines that may reach it."""
        return SEES * self.spacing_mm

    @classmethod
    def around(cls, surface: TriMesh, *, spacing_mm: float, fade_mm: float) -> BoneDistances:
        """Of the bones that closed surfaces bound.

        Parameters
        ----------
        surface : TriMesh
        spacing_mm : float
            Of the lattice's nodes.
        fade_mm : float
            Distances are known this far from the surface.
        """
        h = spacing_mm
        samples = surface_grid(surface, spacing_mm=SAMPLED * h)
        reach = fade_mm + 2.0 * h
        side = SIDE * h
        low = np.floor((samples.min(axis=0) - reach) / side) * side + 0.5 * h
        shape = np.ceil((samples.max(axis=0) + reach - low) / side).astype(np.int64) + 1
        thinned = surface_grid(surface, spacing_mm=THINNED * h)
        near = _bricks_near(thinned, low, side, shape, reach)
        bricks = np.full(tuple(shape), NOTHING, dtype=np.int32)
        bricks[tuple(near.T)] = np.arange(len(near))
        inside = _inside(samples, low, side, shape)
        bricks[inside & (bricks == NOTHING)] = WHOLE
        inner = np.empty((len(near), SIDE, SIDE, SIDE), dtype=np.float32)
        _propagate(near, low, h, thinned, *_coarse(thinned, near, low, side), inner)
        _seal(samples, low, h, bricks, np.float64(SEALS), inner)
        state = np.zeros(inner.shape, dtype=np.uint8)
        _flood(bricks, inner > 0.0, state, near, shape)
        inner[state == 0] = 0.0
        distances = np.full((len(near), ACROSS**3), FAR, dtype=np.float32)
        _with_borders(bricks, inner, near, distances)
        return cls(low, h, bricks, distances, fade_mm)

    def weights(self) -> WeightLattice:
        """The weights where no other bone is near."""
        values = _faded(self.distances, self.sees_mm, self.fade_mm)
        return WeightLattice(self.low, self.spacing_mm, self.bricks, values)


def surface_grid(surface: TriMesh, *, spacing_mm: float) -> Points:
    """(N, 3) points of a surface: none of its places is farther than about 0.6 times the spacing from one, mm."""
    corners = surface.vertices[surface.faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    cuts = np.maximum(np.ceil(sides / spacing_mm).astype(int), 1)
    parts = [surface.vertices]
    for n in np.unique(cuts):
        a, b, c = corners[cuts == n].transpose(1, 0, 2)
        if n == 1:
            parts.append((a + b + c) / 3.0)
            continue
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        kept = i + j <= n
        u, v = i[kept] / n, j[kept] / n
        places = a[:, None] + u[None, :, None] * (b - a)[:, None] + v[None, :, None] * (c - a)[:, None]
        parts.append(places.reshape(-1, 3))
    points = np.concatenate(parts)
    cells = np.floor(points / (0.35 * spacing_mm)).astype(np.int64)
    cells -= cells.min(axis=0)
    spans = cells.max(axis=0) + 1
    keys = (cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]
    kept_first: Points = points[np.unique(keys, return_index=True)[1]]
    return kept_first


def _bricks_near(samples: Points, low: Float, side: float, shape: NDArray[np.int64], reach: float) -> NDArray[np.int64]:
    """Indices (R, 3) of the bricks that have a place within reach of a sample."""
    own = np.unique(np.floor((samples - low) / side + 1e-9).astype(np.int64), axis=0)
    span = int(np.ceil(reach / side)) + 1
    steps = np.stack(np.meshgrid(*[np.arange(-span, span + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    gaps = np.maximum(np.abs(steps) - 1, 0) * side
    steps = steps[np.linalg.norm(gaps, axis=1) <= reach]
    seen = np.zeros(tuple(shape), dtype=bool)
    for step in steps:
        moved = own + step
        kept = ((moved >= 0) & (moved < shape)).all(axis=1)
        seen[tuple(moved[kept].T)] = True
    candidates = np.argwhere(seen)
    centres = low + (candidates + 0.5) * side
    distances = cKDTree(samples).query(centres, distance_upper_bound=reach + 0.87 * side + side)[0]
    found: NDArray[np.int64] = candidates[distances <= reach + 0.87 * side]
    return found


def _coarse(
    samples: Points, near: NDArray[np.int64], low: Float, side: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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
    """Write 0 at every node within ``seals`` spacings of a sample along each axis."""
    side = inner.shape[1]
    first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for s in range(len(samples)):
        for axis in range(3):
            u = (samples[s, axis] - low[axis]) / h
            first[axis], last[axis] = int(np.ceil(u - seals)), int(np.floor(u + seals))
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                for k in range(first[2], last[2] + 1):
                    row = bricks[i // side, j // side, k // side]
                    inner[row, i % side, j % side, k % side] = np.float32(0.0)


def _inside(samples: Points, low: Float, side: float, shape: NDArray[np.int64]) -> Bool:
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


@njit(cache=True)
def _flood(bricks, free, state, places, shape):
    """Mark free nodes that are joined to bricks out of reach, or to the lattice's border, in ``state``."""
    side = free.shape[1]
    stack = [(np.int64(0), np.int64(0), np.int64(0), np.int64(0))]
    stack.pop()
    for row in range(len(places)):
        for axis in range(3):
            for way in (-1, 1):
                a, b, c = places[row, 0], places[row, 1], places[row, 2]
                if axis == 0:
                    a += way
                elif axis == 1:
                    b += way
                else:
                    c += way
                beyond = not (0 <= a < shape[0] and 0 <= b < shape[1] and 0 <= c < shape[2])
                if not beyond and bricks[a, b, c] != -1:
                    continue
                at = 0 if way < 0 else side - 1
                for p in range(side):
                    for q in range(side):
                        i = at if axis == 0 else p
                        j = at if axis == 1 else (p if axis == 0 else q)
                        k = at if axis == 2 else q
                        if free[row, i, j, k] and state[row, i, j, k] == 0:
                            state[row, i, j, k] = 1
                            stack.append((np.int64(row), np.int64(i), np.int64(j), np.int64(k)))
    while len(stack):
        row, i, j, k = stack.pop()
        for axis in range(3):
            for way in (-1, 1):
                x, y, z, r = i, j, k, row
                if axis == 0:
                    x += way
                elif axis == 1:
                    y += way
                else:
                    z += way
                a, b, c = places[row, 0], places[row, 1], places[row, 2]
                if x < 0 or x >= side:
                    a += way
                    x = side - 1 if way < 0 else 0
                elif y < 0 or y >= side:
                    b += way
                    y = side - 1 if way < 0 else 0
                elif z < 0 or z >= side:
                    c += way
                    z = side - 1 if way < 0 else 0
                if not (0 <= a < shape[0] and 0 <= b < shape[1] and 0 <= c < shape[2]):
                    continue
                r = bricks[a, b, c]
                if r < 0:
                    continue
                if free[r, x, y, z] and state[r, x, y, z] == 0:
                    state[r, x, y, z] = 1
                    stack.append((np.int64(r), np.int64(x), np.int64(y), np.int64(z)))


@njit(parallel=True, cache=True)
def _with_borders(bricks, inner, places, distances):
    """Lay out nodes as values are, with those of the neighbouring bricks around."""
    side = inner.shape[1]
    across = side + 2
    for row in prange(len(places)):
        for i in range(across):
            for j in range(across):
                for k in range(across):
                    a, b, c = places[row, 0], places[row, 1], places[row, 2]
                    x, y, z = i - 1, j - 1, k - 1
                    if x < 0:
                        a, x = a - 1, side - 1
                    elif x >= side:
                        a, x = a + 1, 0
                    if y < 0:
                        b, y = b - 1, side - 1
                    elif y >= side:
                        b, y = b + 1, 0
                    if z < 0:
                        c, z = c - 1, side - 1
                    elif z >= side:
                        c, z = c + 1, 0
                    if not (0 <= a < bricks.shape[0] and 0 <= b < bricks.shape[1] and 0 <= c < bricks.shape[2]):
                        continue
                    r = bricks[a, b, c]
                    if r == -2:
                        distances[row, (i * across + j) * across + k] = np.float32(0.0)
                    elif r >= 0:
                        distances[row, (i * across + j) * across + k] = inner[r, x, y, z]


@njit(inline="always")
def _smooth(t):
    """From 1 at 0 down to 0 at 1, level at both ends."""
    t = min(max(t, 0.0), 1.0)
    return 1.0 - t * t * (3.0 - 2.0 * t)


@njit(parallel=True, cache=True)
def _faded(distances, sees, fade):
    values = np.empty(distances.shape, np.uint16)
    for row in prange(distances.shape[0]):
        for at in range(distances.shape[1]):
            values[row, at] = np.uint16(65535.0 * _smooth((distances[row, at] - sees) / (fade - sees)))
    return values


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
    alone : tuple of WeightLattice
        Its weights where no other group is near.
    gap_mm : float
        Where two groups come closer than this, neither is locked; from 1.6 times as far both are, whole.
    """

    distances: tuple[BoneDistances, ...]
    alone: tuple[WeightLattice, ...]
    gap_mm: float

    @classmethod
    def around(cls, surfaces: Sequence[TriMesh], *, spacing_mm: float, fade_mm: float, gap_mm: float) -> BoneLocks:
        """Of the groups that closed surfaces at rest bound."""
        found = tuple(BoneDistances.around(s, spacing_mm=spacing_mm, fade_mm=fade_mm) for s in surfaces)
        return cls(found, tuple(distances.weights() for distances in found), gap_mm)

    def of_step(self, before: Sequence[Stand], after: Sequence[Stand]) -> tuple[Lock, ...]:
        """The locks of a Cayley step from one stand of every group to another.

        Raises
        ------
        FieldError
            A group turns by about 180 degrees.
        """
        middles = [a.half_way(b) for a, b in zip(before, after, strict=True)]
        weights = step_weights(self.distances, middles, self.alone, gap_mm=self.gap_mm)
        return tuple(
            Lock.of_step(weight, (a.linear, a.translation), (b.linear, b.translation))
            for weight, a, b in zip(weights, before, after, strict=True)
        )


def step_weights(
    bones: Sequence[BoneDistances], stands: Sequence[Stand], alone: Sequence[WeightLattice], *, gap_mm: float
) -> tuple[WeightLattice, ...]:
    """The weights of every group where all stand as they do.

    Parameters
    ----------
    bones : sequence of BoneDistances
    stands : sequence of Stand
        In the middle of a step.
    alone : sequence of WeightLattice
        Of each group where no other is near.
    gap_mm : float
        Bones closer than this to another are not locked there; from 1.6 times as far they are locked whole.
    """
    found = []
    for k, (own, weight) in enumerate(zip(bones, alone, strict=True)):
        others = [j for j in range(len(bones)) if j != k]
        touched = _near_others(own, stands[k], [bones[j] for j in others], [stands[j] for j in others])
        if not touched.size:
            found.append(weight)
            continue
        values = _shared_values(k, own, touched, bones, stands, gap_mm)
        bricks = own.bricks.copy()
        places = np.argwhere(own.bricks >= 0)
        at = np.empty(len(own.distances), dtype=np.int64)
        at[own.bricks[tuple(places.T)]] = np.arange(len(places))
        bricks[tuple(places[at[touched]].T)] = len(weight.values) + np.arange(len(touched))
        found.append(WeightLattice(own.low, own.spacing_mm, bricks, np.concatenate([weight.values, values])))
    return tuple(found)


def _brick_centres(bones: BoneDistances) -> Points:
    places = np.argwhere(bones.bricks >= 0)
    centres = np.empty((len(bones.distances), 3))
    side = SIDE * bones.spacing_mm
    centres[bones.bricks[tuple(places.T)]] = bones.low + (places + 0.5) * side - 0.5 * bones.spacing_mm
    return centres


def _near_others(
    own: BoneDistances, stand: Stand, others: Sequence[BoneDistances], stands: Sequence[Stand]
) -> NDArray[np.int64]:
    """Rows of the bricks in which another group's distances are known."""
    centres = stand(_brick_centres(own))
    near = np.zeros(len(centres), dtype=bool)
    for other, there in zip(others, stands, strict=True):
        back = np.linalg.inv(there.linear)
        places = (centres - there.translation) @ back.T
        side = SIDE * other.spacing_mm
        index = np.floor((places - other.low) / side + 0.5 / SIDE).astype(np.int64)
        span = int(np.ceil(0.87 * SIDE * own.spacing_mm / side)) + 1
        known = _dilated(other.bricks != NOTHING, span)
        kept = ((index >= -span) & (index < np.array(other.bricks.shape) + span)).all(axis=1)
        near[kept] |= known[tuple((index[kept] + span).T)]
    return np.flatnonzero(near)


def _dilated(seen: Bool, span: int) -> Bool:
    """Grown by a number of cells along every axis, in an array that is larger by as many on every side."""
    grown = np.pad(seen, span)
    for axis in range(3):
        whole = grown.copy()
        for step in range(1, span + 1):
            whole |= np.roll(grown, step, axis=axis) | np.roll(grown, -step, axis=axis)
        grown = whole
    return grown


def _shared_values(
    k: int,
    own: BoneDistances,
    rows: NDArray[np.int64],
    bones: Sequence[BoneDistances],
    stands: Sequence[Stand],
    gap_mm: float,
) -> NDArray[np.uint16]:
    places = np.argwhere(own.bricks >= 0)
    corners = np.empty((len(own.distances), 3))
    corners[own.bricks[tuple(places.T)]] = own.low + places * SIDE * own.spacing_mm
    squares, nearest = np.zeros((len(rows), ACROSS**3)), np.full((len(rows), ACROSS**3), np.float64(FAR))
    for j, other in enumerate(bones):
        if j == k:
            continue
        back = np.linalg.inv(stands[j].linear)
        linear = back @ stands[k].linear
        shift = back @ (stands[k].translation - stands[j].translation)
        _add_other(
            corners[rows],
            own.spacing_mm,
            linear,
            shift,
            other.low,
            other.spacing_mm,
            other.bricks,
            other.distances,
            other.sees_mm,
            squares,
            nearest,
        )
    values = np.empty((len(rows), ACROSS**3), dtype=np.uint16)
    _write_shared(own.distances[rows], squares, nearest, own.sees_mm, own.fade_mm, gap_mm, values)
    return values


@njit(inline="always")
def _distance_at(low, h, bricks, distances, x, y, z):
    """Distance at a place of the lattice's frame, between its nodes; far where it is not known."""
    u, v, w = (x - low[0]) / h, (y - low[1]) / h, (z - low[2]) / h
    i, j, k = int(np.floor(u)), int(np.floor(v)), int(np.floor(w))
    a, b, c = i // SIDE, j // SIDE, k // SIDE
    if not (0 <= a < bricks.shape[0] and 0 <= b < bricks.shape[1] and 0 <= c < bricks.shape[2]):
        return 1e6
    row = bricks[a, b, c]
    if row == -1:
        return 1e6
    if row == -2:
        return 0.0
    u, v, w = u - i, v - j, w - k
    start = ((i - a * SIDE + 1) * ACROSS + j - b * SIDE + 1) * ACROSS + k - c * SIDE + 1
    total = 0.0
    for p in range(2):
        for q in range(2):
            for r in range(2):
                part = distances[row, start + (p * ACROSS + q) * ACROSS + r]
                if part > 1e5:
                    return 1e6
                total += (u if p else 1.0 - u) * (v if q else 1.0 - v) * (w if r else 1.0 - w) * part
    return total


@njit(parallel=True, cache=True)
def _add_other(corners, h, linear, shift, low, spacing, bricks, distances, sees, squares, nearest):
    for row in prange(len(corners)):
        for i in range(ACROSS):
            for j in range(ACROSS):
                for k in range(ACROSS):
                    x = corners[row, 0] + (i - 1) * h
                    y = corners[row, 1] + (j - 1) * h
                    z = corners[row, 2] + (k - 1) * h
                    d = _distance_at(
                        low,
                        spacing,
                        bricks,
                        distances,
                        linear[0, 0] * x + linear[0, 1] * y + linear[0, 2] * z + shift[0],
                        linear[1, 0] * x + linear[1, 1] * y + linear[1, 2] * z + shift[1],
                        linear[2, 0] * x + linear[2, 1] * y + linear[2, 2] * z + shift[2],
                    )
                    at = (i * ACROSS + j) * ACROSS + k
                    if d < 1e5:
                        free = max(d - sees, 1e-3)
                        squares[row, at] += 1.0 / (free * free)
                        nearest[row, at] = min(nearest[row, at], d)


@njit(parallel=True, cache=True)
def _write_shared(distances, squares, nearest, sees, fade, gap, values):
    for row in prange(distances.shape[0]):
        for at in range(distances.shape[1]):
            d = distances[row, at]
            w = _smooth((d - sees) / (fade - sees))
            if nearest[row, at] < 1e5 and w > 0.0:
                free = max(d - sees, 0.0)
                w *= 1.0 / (1.0 + free * free * squares[row, at])
                w *= 1.0 - _smooth((d + nearest[row, at] - gap) / (0.6 * gap))
            values[row, at] = np.uint16(65535.0 * w)
