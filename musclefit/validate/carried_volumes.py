"""How large a part of the rest anatomy is after the map: surface and map -> volume; judges nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Gradients, Points
from musclefit.geometry.measures import area_vectors, enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.solids import refined_to
from musclefit.geometry.surfaces.subdivision import FaceEdges, split_edges

SETTLED_MM3 = 0.02
"""A mapped volume is settled when the last refinement changed it by less than this (or by SETTLED_RELATIVE), mm³.

Measured on 3,075 overlaps of a whole body that grew heavier: this limit left 0.004 mm³ at most and 0.11 mm³ in sum,
against a limit of 0.002.
"""
SETTLED_RELATIVE = 1e-6
"""See SETTLED_MM3; matters only from 20,000 mm³ on."""
SETTLED_SHARE = 0.01
"""It is settled, too, when the change is less than this share of its distance from what it is compared with."""
BATCH_TRIANGLES = 400_000
"""Surfaces are refined in batches of about so many triangles at the start, so that memory stays small."""
START_EDGE_MM = 5.0
"""Longer edges are split before the first estimate, so that no bend of the map hides between vertices, mm."""
MAX_TRIANGLES = 1_000_000
"""A surface is never refined beyond this many triangles."""

Mapped = Callable[[Points], tuple[Points, Gradients]]
"""The whole map, rest to deformed: (N, 3) mm -> (N, 3) mm and its (N, 3, 3) Jacobians."""


@dataclass(frozen=True, slots=True)
class CarriedVolume:
    """Volume of a mapped surface, how much the last refinement changed it, and how much it may, mm³."""

    volume_mm3: float
    last_change_mm3: float
    enough_mm3: float = 0.0

    @property
    def settled(self) -> bool:
        """True when refining the surface further would hardly change the volume."""
        return self.last_change_mm3 <= max(_settled_mm3(self.volume_mm3), self.enough_mm3)

    def doubt(self) -> str:
        """Why the volume is not settled, in words."""
        if not np.isfinite(self.last_change_mm3):
            return f"{self.volume_mm3:.6g} mm³, but its surface is too large to refine, so how exact that is is unknown"
        return f"{self.volume_mm3:.6g} mm³, but the last refinement still changed it by {self.last_change_mm3:.3g} mm³"


def carried_volumes(
    surfaces: Sequence[TriMesh], *, against: Sequence[float], mapped: Mapped, tick: Callable[[float], None]
) -> tuple[CarriedVolume, ...]:
    r"""Volumes enclosed by closed surfaces after a map, refining each surface until its volume settles.

    The map's Jacobians J at the ends of an edge e say where its middle goes, by a cubic through both:
    :math:`(y_0 + y_1) / 2 + (J_0 - J_1) e / 8`, off by a fourth power of the edge's length. So each level of vertices
    gives two volumes, V of its triangles and V' of those cut in four, both off by a square of the length, and
    :math:`V' + \tfrac{1}{3} (V' - V)` is off by a fourth power. Where that differs too much from the level before (the
    first one: from its own V'), all edges are halved and the new vertices mapped.

    Parameters
    ----------
    surfaces : sequence of TriMesh
        Closed, at rest.
    against : sequence of float
        What each volume will be compared with, mm³: the farther it is from that, the less exact it need be.
    mapped : callable
        Called once per level and batch with the new vertices of all surfaces that have not settled.
    tick : callable
        Told the fraction of surfaces that have settled.

    Returns
    -------
    tuple of CarriedVolume
        In the order of ``surfaces``. ``last_change_mm3`` is an estimate of the error, no bound; it is infinite where a
        surface is too large to cut its long edges.
    """
    found = [CarriedVolume(np.nan, np.inf)] * len(surfaces)
    for batch in _batches(surfaces):
        _refine(batch, surfaces, found, against=against, mapped=mapped)
        tick((batch[-1] + 1) / len(surfaces))
    return tuple(found)


def _batches(surfaces: Sequence[TriMesh]) -> list[range]:
    """Consecutive numbers of surfaces, together of about ``BATCH_TRIANGLES``."""
    starts, filled = [0], 0
    for i, surface in enumerate(surfaces):
        filled += len(surface.faces)
        if filled > BATCH_TRIANGLES and i + 1 < len(surfaces):
            starts.append(i + 1)
            filled = 0
    return [range(a, b) for a, b in zip(starts, [*starts[1:], len(surfaces)], strict=True) if b > a]


@dataclass(slots=True)
class _Level:
    """A surface at rest, as fine as it is by now, and where the map takes its vertices."""

    surface: TriMesh
    edges: FaceEdges
    moved: Points
    slopes: Gradients

    def middles(self) -> Points:
        """(e, 3) places to which the map takes the middles of the edges, as the slopes at their ends have it."""
        a, b = self.edges.ends.T
        along = self.surface.vertices[b] - self.surface.vertices[a]
        bend = np.einsum("eij,ej->ei", self.slopes[a] - self.slopes[b], along)
        middles: Points = 0.5 * (self.moved[a] + self.moved[b]) + 0.125 * bend
        return middles


def _refine(
    batch: range, surfaces: Sequence[TriMesh], found: list[CarriedVolume], *, against: Sequence[float], mapped: Mapped
) -> None:
    """Refine the surfaces of one batch until their volumes, put into ``found``, have settled."""
    levels = {i: _first_level(surfaces[i]) for i in batch}
    while levels:
        _move_new(list(levels.values()), mapped)
        finer = {}
        for i, level in levels.items():
            halved = split_edges(level.surface, level.edges, np.ones(len(level.edges.ends), dtype=bool))
            coarse = enclosed_volume(level.surface.with_vertices(level.moved))
            fine = enclosed_volume(halved.with_vertices(np.concatenate([level.moved, level.middles()])))
            volume = fine + (fine - coarse) / 3.0
            before = fine if np.isnan(found[i].volume_mm3) else found[i].volume_mm3
            change = abs(volume - before) if _expected_triangles(surfaces[i]) <= MAX_TRIANGLES else np.inf
            found[i] = CarriedVolume(volume, change, SETTLED_SHARE * abs(volume - against[i]))
            if not found[i].settled and len(halved.faces) <= MAX_TRIANGLES:
                finer[i] = _Level(halved, FaceEdges.of(halved.faces), level.moved, level.slopes)
        levels = finer


def _settled_mm3(volume: float) -> float:
    return max(SETTLED_MM3, SETTLED_RELATIVE * abs(volume))


def _move_new(levels: Sequence[_Level], mapped: Mapped) -> None:
    """Map the vertices that are new, of all surfaces in one call."""
    fresh = [level.surface.vertices[len(level.moved) :] for level in levels]
    moved, slopes = mapped(np.concatenate(fresh))
    ends = np.cumsum([len(part) for part in fresh])[:-1]
    for level, more, steeper in zip(levels, np.split(moved, ends), np.split(slopes, ends), strict=True):
        level.moved = np.concatenate([level.moved, more])
        level.slopes = np.concatenate([level.slopes, steeper])


def _first_level(surface: TriMesh) -> _Level:
    """The surface without long edges; as it is where it is too large for that."""
    if _expected_triangles(surface) <= MAX_TRIANGLES:
        surface = refined_to(surface, edge_length_mm=START_EDGE_MM)
    return _Level(surface, FaceEdges.of(surface.faces), np.zeros((0, 3)), np.zeros((0, 3, 3)))


def _expected_triangles(surface: TriMesh) -> float:
    """About as many as there are without long edges."""
    area = float(np.linalg.norm(area_vectors(surface), axis=1).sum())
    return len(surface.faces) + area / (math.sqrt(3.0) / 8.0 * START_EDGE_MM**2)
