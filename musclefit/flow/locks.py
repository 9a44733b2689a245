"""Where bones lock the field: smooth distances from rigid bones at rest on lattices, and the locks of one step.

Takes bones' surfaces and where they stand; gives `musclefit.fields.locked.Lock`. That a bone's weight is 1 on its whole
surface, where no other bone is near, holds by construction: smooth distances are made no larger there than a length,
up to which weights are whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from musclefit.compiling import njit
from musclefit.errors import FieldError
from musclefit.fields.evaluation import bricks as sums
from musclefit.fields.evaluation.bricks import ACROSS, NOTHING, ONE, SIDE, WHOLE
from musclefit.fields.locked import Fade, Lock, LockedField, Nearness
from musclefit.flow.steps import CayleyStep, Step, Trial
from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree
from musclefit.geometry.queries.solids import pieces
from musclefit.geometry.queries.winding import inside_surface
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surfaces.samples import surface_places
from musclefit.progress import Progress, Silent

SAMPLED = 0.3
"""How far a place of a surface may be from a sample of it, in units of the lattice's spacing."""

ON_SURFACE = 0.25
"""Smooth distances at samples of the surface are made no larger than this, in units of the lattice's spacing."""

BRICKS_AT_ONCE = 1024
"""Bricks whose nodes' distances are measured at once: what they take in memory does not grow with the bone."""

WITHIN = 2.0
"""How far within a bone distances are known, in units of the lattice's spacing."""

ZONE = 1.25
"""How much nearer than their fading says bones must be to each other before locks give way, in units of the lattice's
spacing: smooth distances are off by less, and so is where bones stand in the middle of a step."""


@dataclass(frozen=True, eq=False, slots=True)
class Stand:
    """Where a group of bones stands: x -> linear x + translation, from rest."""

    linear: Float
    translation: Float

    @classmethod
    def of(cls, motion: RigidMotion) -> Stand:
        """Where a rigid motion takes it."""
        return cls(np.asarray(motion.rotation), np.asarray(motion.translation))


@dataclass(frozen=True, slots=True)
class LockSettings:
    """How one group of bones is locked.

    Parameters
    ----------
    spacing_mm : float
        Of the nodes of the lattice on which the distance from it is smooth.
    fade : Fade

    Raises
    ------
    FieldError
        A lattice too wide for weights to fade over so short a length.
    """

    spacing_mm: float
    fade: Fade

    def __post_init__(self) -> None:
        shortest = min(self.fade.over_mm, self.fade.apart_mm)
        if not shortest >= self.spacing_mm > 0.0:
            raise FieldError(
                f"locks fade over {shortest:.3g} mm on a lattice of {self.spacing_mm:.3g} mm, which is wider; take a "
                "narrower lattice"
            )

    @property
    def zone_mm(self) -> float:
        """A place of the surface that is farther than this from every other bone moves exactly with its own."""
        return self.fade.apart_mm + ZONE * self.spacing_mm


@dataclass(frozen=True, eq=False, slots=True)
class BoneLocks:
    """What locks groups of bones, prepared at rest once for all steps.

    Parameters
    ----------
    near : tuple of Nearness
        Of each group.
    fades : tuple of Fade
    """

    near: tuple[Nearness, ...]
    fades: tuple[Fade, ...]

    @classmethod
    def around(
        cls, surfaces: Sequence[TriMesh], settings: Sequence[LockSettings], *, progress: Progress | None = None
    ) -> BoneLocks:
        """Of the groups that closed surfaces at rest bound.

        Parameters
        ----------
        surfaces : sequence of TriMesh
        settings : sequence of LockSettings
            One for each.
        """
        farthest = max(setting.fade.apart_mm for setting in settings)
        found = []
        with (progress or Silent()).stage("distances around bones") as tick:
            for surface, setting in zip(surfaces, settings, strict=True):
                h = setting.spacing_mm
                # Where one bone counts, others are known as far as they matter to it.
                reach = 2.0 * ZONE * h + max(s.fade.over_mm for s in settings) + farthest
                found.append(nearness_of(surface, spacing_mm=h, reach_mm=reach))
                tick(len(found) / len(surfaces))
        return cls(tuple(found), tuple(setting.fade for setting in settings))

    def of_step(self, before: Sequence[Stand], after: Sequence[Stand]) -> tuple[Lock, ...]:
        """The locks of a Cayley step from one stand of every group to another.

        Raises
        ------
        FieldError
            A group turns by about 180 degrees.
        """
        return tuple(
            Lock.of_step(near, fade, (a.linear, a.translation), (b.linear, b.translation))
            for near, fade, a, b in zip(self.near, self.fades, before, after, strict=True)
        )


def trial_without_locks(step: Step, held: Points, *, exact: int) -> Trial:
    """A step tried on places that it is held to: all but the first few go where it would take them without locks.

    So every step makes up for what those before it missed, and what the locks add to them does not add up.

    Parameters
    ----------
    step : Step
    held : (h, 3) float64, mm
    exact : int
        The first so many are no samples of bones: they go where the step takes them.
    """
    field = step.field
    if not isinstance(field, LockedField):
        return step.trial(held)
    handles, samples = step.trial(held[:exact]), CayleyStep(field.base)(held[exact:])
    still = np.zeros((len(samples), 3, 3))
    return Trial(np.concatenate([handles.moved, samples]), np.concatenate([handles.gradients, still]))


def with_zone(locks: Sequence[LockSettings], zone_mm: float) -> tuple[LockSettings, ...]:
    """Locks that give way to each other within a zone of a given width, on lattices that are narrow enough for it."""
    spacings = [min(lock.spacing_mm, zone_mm / (2.0 + ZONE)) for lock in locks]
    apart = zone_mm - ZONE * max(spacings, default=0.0)
    return tuple(
        LockSettings(spacing, Fade(max(min(lock.fade.over_mm, apart), spacing), apart))
        for lock, spacing in zip(locks, spacings, strict=True)
    )


def nearness_of(surface: TriMesh, *, spacing_mm: float, reach_mm: float) -> Nearness:
    """The smooth distance from what a closed surface bounds.

    Parameters
    ----------
    surface : TriMesh
        Of one bone or of several, which may share space.
    spacing_mm : float
        Of the lattice's nodes.
    reach_mm : float
        What lies farther away than this is as far away as this.

    Raises
    ------
    IndexError
        A node beside the surface is in no brick near it, which can only be where the distances are wrong.
    """
    h, side, depth = spacing_mm, SIDE * spacing_mm, WITHIN * spacing_mm
    beyond = max(reach_mm, depth) + np.sqrt(3.0) * 0.5 * ACROSS * h  # of a brick and of the nodes that it sees
    low = surface.vertices.min(axis=0) - beyond
    shape = np.ceil((surface.vertices.max(axis=0) + beyond - low) / side).astype(np.int64)
    every = np.argwhere(np.ones(tuple(shape), dtype=bool))
    solid = _Solid(surface)
    apart = solid.signed_distances(low + (every * SIDE + 0.5 * (SIDE - 1)) * h)
    close = np.abs(apart) <= beyond
    near = every[close]
    bricks = np.full(tuple(shape), NOTHING, dtype=np.int32)
    bricks[tuple(every[apart < -beyond].T)] = WHOLE
    bricks[tuple(near.T)] = np.arange(len(near))
    whole = reach_mm + depth
    inner = np.empty((len(near), SIDE, SIDE, SIDE), dtype=np.uint16)
    for first in range(0, len(near), BRICKS_AT_ONCE):
        some = slice(first, first + BRICKS_AT_ONCE)
        distances = _of_nodes(
            solid, low + h * SIDE * near[some], apart[close][some], h, reach_mm=reach_mm, depth_mm=depth
        )
        inner[some] = np.round(ONE * np.clip((reach_mm - distances) / whole, 0.0, 1.0))
    at, gap = surface_places(surface, spacing_mm=SAMPLED * h)
    level = ONE * (reach_mm - ON_SURFACE * h) / whole
    values = np.empty((len(near), ACROSS**3), dtype=np.uint16)
    sums.with_borders(bricks, near, inner, values)
    found, slopes = np.empty(len(at)), np.empty((len(at), 3))
    sums.moved_values_at(low, h, bricks, values, np.eye(3), np.zeros(3), at, found, slopes)
    _raise_beside(at, low, h, bricks, np.ceil(level - ONE * found).astype(np.int64), inner)
    sums.with_borders(bricks, near, inner, values)
    nearness = _packed(Nearness(low, h, bricks, values, reach_mm, depth, 0.0))
    return _held(nearness, at, gap)


class _Solid:
    """What a closed surface goes around; what has several parts goes around what any of them does."""

    def __init__(self, surface: TriMesh) -> None:
        self._tree, self._parts = DistanceTree(surface), pieces(surface)

    def signed_distances(self, points: Points) -> Float:
        """(N,) distances of (N, 3) points from the surface, mm; negative within."""
        found = self._tree(points)
        found[self.holds(points)] *= -1.0
        return found

    def distances(self, points: Points) -> Float:
        """The same without a sign."""
        return self._tree(points)

    def holds(self, points: Points) -> Bool:
        """(N,) which points are within."""
        held: Bool = np.zeros(len(points), dtype=bool)
        for part in self._parts:
            held[~held] = inside_surface(part, points[~held])
        return held


def _of_nodes(solid: _Solid, corners: Points, middles: Float, h: float, *, reach_mm: float, depth_mm: float) -> Float:
    """Signed distances (B, SIDE, SIDE, SIDE) of the nodes of bricks, mm, from the first node (B, 3) and the middle's.

    Around the middle of a brick, up to its distance from the surface, every point is on the same side of it. Beyond
    ``reach_mm`` and ``depth_mm`` distances are not measured, but bounded by the middle's.
    """
    steps = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    away = h * np.linalg.norm(steps - 0.5 * (SIDE - 1), axis=1)
    middle = np.repeat(middles, len(steps))
    least = np.abs(middle) - np.tile(away, len(middles))  # no node is nearer to the surface
    found = np.sign(middle) * least
    measured = np.flatnonzero(least < np.where(middle > 0.0, reach_mm, depth_mm))
    places = (corners[:, None, :] + h * steps).reshape(-1, 3)[measured]
    within = middle[measured] < 0.0
    either = np.flatnonzero(least[measured] <= 1e-6 * h)
    within[either] = solid.holds(places[either])
    found[measured] = np.where(within, -1.0, 1.0) * solid.distances(places)
    of_bricks: Float = found.reshape(-1, SIDE, SIDE, SIDE)
    return of_bricks


def _packed(of: Nearness) -> Nearness:
    """Without the rows of bricks that see no other value than 0 or 1."""
    nothing, whole = (of.values == 0).all(axis=1), (of.values == ONE).all(axis=1)
    kept = ~(nothing | whole)
    rows = np.where(nothing, NOTHING, np.where(whole, WHOLE, np.cumsum(kept) - 1)).astype(np.int32)
    bricks = np.where(of.bricks >= 0, rows[np.maximum(of.bricks, 0)], of.bricks)
    return replace(of, bricks=bricks, values=of.values[kept])


def _held(of: Nearness, samples: Points, gap: float) -> Nearness:
    """With the largest distance on the surface that is proved from samples of it and the gap between them."""
    distances, slopes = of.at(samples)
    steep = of.slope_ranges(samples, np.full_like(samples, gap), slopes)[:, 0]
    return replace(of, surface_mm=float((distances + steep * gap).max()) + 1e-6)


@njit(cache=True)
def _raise_beside(samples, low, h, bricks, missing, inner):
    """Raise the values that a sample sees by what is missing there; where several ask, by the most that one does."""
    raised = np.zeros(inner.shape, np.int64)
    node = np.zeros(3, np.int64)
    for s in range(len(samples)):
        if missing[s] <= 0:
            continue
        for axis in range(3):
            node[axis] = int(np.floor((samples[s, axis] - low[axis]) / h + 0.5))
        for i in range(node[0] - 1, node[0] + 2):
            for j in range(node[1] - 1, node[1] + 2):
                for k in range(node[2] - 1, node[2] + 2):
                    row = bricks[i // SIDE, j // SIDE, k // SIDE]
                    if row < 0:
                        raise IndexError("a node beside the surface is in no brick near it")
                    a, b, c = i % SIDE, j % SIDE, k % SIDE
                    raised[row, a, b, c] = max(raised[row, a, b, c], missing[s])
    for row in range(len(inner)):
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    value = np.int64(inner[row, i, j, k]) + raised[row, i, j, k]
                    inner[row, i, j, k] = np.uint16(min(value, 65535))
