"""How large a part of the rest anatomy is after the map: surface and map -> volume; judges nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.solids import refined_to
from musclefit.geometry.volumes import area_vectors, enclosed_volume

SETTLED_MM3 = 0.02
"""A mapped volume is settled when the last refinement changed it by less than this (or by SETTLED_RELATIVE), mm³.

Measured on 270 overlaps of a segmented forearm that was flexed: a limit of 0.05 left 0.011 mm³ at most and 0.02 mm³ in
sum, against a limit of 0.002.
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

Mapped = Callable[[Points], Points]
"""The whole map, rest to deformed: (N, 3) mm -> (N, 3) mm."""


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

    Each level halves all edges. The volume of a polyhedron with mapped vertices is off by a series in even powers of
    the edge length for a smooth map, so the levels are extrapolated (Romberg):
    :math:`R_{k,0} = V_k,\; R_{k,j} = R_{k,j-1} + (R_{k,j-1} - R_{k-1,j-1}) / (4^j - 1)`.

    Parameters
    ----------
    surfaces : sequence of TriMesh
        Closed, at rest.
    against : sequence of float
        What each volume will be compared with, mm³: the farther it is from that, the less exact it need be.
    mapped : callable
        Called once per level and batch with the vertices of all surfaces that have not settled.
    tick : callable
        Told the fraction of surfaces that have settled.

    Returns
    -------
    tuple of CarriedVolume
        In the order of ``surfaces``. ``last_change_mm3`` is an estimate of the error, no bound; it is infinite where a
        surface could not be refined at all.

    References
    ----------
    W. Romberg, Det Kgl. Norske Videnskabers Selskab Forhandlinger 28 (1955) 30.
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


def _refine(
    batch: range, surfaces: Sequence[TriMesh], found: list[CarriedVolume], *, against: Sequence[float], mapped: Mapped
) -> None:
    """Refine the surfaces of one batch until their volumes, put into ``found``, have settled."""
    finer = {i: _started(surfaces[i]) for i in batch}
    tableaus: dict[int, list[float]] = {i: [] for i in batch}
    while finer:
        for i, moved in zip(finer, _moved(list(finer.values()), mapped), strict=True):
            before = found[i].volume_mm3
            tableaus[i] = _next_romberg_row(tableaus[i], enclosed_volume(moved))
            change = np.inf if np.isnan(before) else abs(tableaus[i][-1] - before)
            found[i] = CarriedVolume(tableaus[i][-1], float(change), SETTLED_SHARE * abs(tableaus[i][-1] - against[i]))
        finer = {
            i: halved(surface)
            for i, surface in finer.items()
            if not found[i].settled and 4 * len(surface.faces) <= MAX_TRIANGLES
        }


def halved(mesh: TriMesh) -> TriMesh:
    """The same surface with every triangle split in four at the middles of its edges."""
    directed = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    low, high, span = directed.min(axis=1), directed.max(axis=1), len(mesh.vertices)
    keys, edge_of = np.unique(low * span + high, return_inverse=True)  # far quicker than unique rows
    edges = np.stack([keys // span, keys % span], axis=1)
    ab, bc, ca = (len(mesh.vertices) + edge_of.reshape(-1, 3)).T
    a, b, c = mesh.faces.T
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return TriMesh(
        np.concatenate([mesh.vertices, mesh.vertices[edges].mean(axis=1)]),
        np.concatenate([np.stack(corner, axis=1) for corner in corners]),
    )


def _next_romberg_row(row: Sequence[float], volume: float) -> list[float]:
    new = [volume]
    for j, coarser in enumerate(row, start=1):
        new.append(new[-1] + (new[-1] - coarser) / (4.0**j - 1.0))
    return new


def _settled_mm3(volume: float) -> float:
    return max(SETTLED_MM3, SETTLED_RELATIVE * abs(volume))


def _moved(surfaces: Sequence[TriMesh], mapped: Mapped) -> list[TriMesh]:
    """The surfaces with mapped vertices, in one call of the map."""
    counts = [len(s.vertices) for s in surfaces]
    moved = mapped(np.concatenate([s.vertices for s in surfaces]))
    parts = np.split(moved, np.cumsum(counts)[:-1])
    return [s.with_vertices(part) for s, part in zip(surfaces, parts, strict=True)]


def _started(surface: TriMesh) -> TriMesh:
    """The surface without long edges; as it is where it is too large for that."""
    area = float(np.linalg.norm(area_vectors(surface), axis=1).sum())
    expected = len(surface.faces) + 2.0 * area / (np.sqrt(3.0) / 4.0 * START_EDGE_MM**2)
    return refined_to(surface, edge_length_mm=START_EDGE_MM) if expected <= MAX_TRIANGLES else surface
