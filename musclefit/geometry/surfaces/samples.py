"""Samples of a surface at a stated spacing, whatever its triangles: places, areas, and the largest gap between."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Float, Int, Points
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.subdivision import with_halved_edges

EDGES_PER_SPACING = math.sqrt(3.0)
"""No place of a triangle is farther from its corners than its longest edge over this: an equilateral one's middle."""


@dataclass(frozen=True, eq=False, slots=True)
class SurfaceSamples:
    """A surface cut until its vertices sample it.

    Parameters
    ----------
    mesh : TriMesh
        The same surface; its vertices are the samples, those of the surface as given first.
    given : int
        How many these are.
    areas : (v,) float64, mm²
        What each sample stands for: a third of each triangle around it. Together the area of the surface.
    gap_mm : float
        No place of the surface is farther than this from a sample.
    middles : tuple of (m, 2) int64
        The samples in whose middle further ones lie, in the order of these (`subdivision.with_halved_edges`).
    """

    mesh: TriMesh
    given: int
    areas: Float
    gap_mm: float
    middles: tuple[Int, ...] = ()

    @property
    def points(self) -> Points:
        """(v, 3) places, mm."""
        return self.mesh.vertices

    @property
    def between(self) -> Points:
        """(v - given, 3) samples that are no vertices of the surface as given, mm."""
        return self.mesh.vertices[self.given :]

    def interpolated(self, values: Float) -> Float:
        """(v,) values at all samples from (given,) at the vertices: linear in each triangle of the surface as given."""
        found = np.asarray(values, dtype=np.float64)
        for ends in self.middles:
            found = np.concatenate([found, found[ends].mean(axis=1)])
        return found


def surface_samples(mesh: TriMesh, *, spacing_mm: float) -> SurfaceSamples:
    """The vertices of a surface, and as many more that no place of it is farther than a spacing from one of them.

    Parameters
    ----------
    mesh : TriMesh
    spacing_mm : float

    Raises
    ------
    MeshError
        A spacing that is not positive and finite.
    """
    if not 0.0 < spacing_mm < math.inf:
        raise MeshError(f"found a spacing of {spacing_mm} mm between samples; expected a finite length above 0")
    cut, middles = with_halved_edges(mesh, longest_mm=EDGES_PER_SPACING * spacing_mm)
    thirds = np.repeat(np.linalg.norm(area_vectors(cut), axis=1) / 3.0, 3)
    areas = np.bincount(cut.faces.ravel(), thirds, minlength=len(cut.vertices)).astype(np.float64)
    return SurfaceSamples(cut, len(mesh.vertices), areas, largest_gap(cut), middles)


def surface_places(mesh: TriMesh, *, spacing_mm: float) -> tuple[Points, float]:
    """Places of a surface of which one is within a spacing of every place of it, and how far they may be at most.

    Each triangle is cut into equal ones by itself, so that places of its sides come once for each triangle: cheaper
    than `surface_samples`, for where neither areas nor neighbours count.

    Parameters
    ----------
    mesh : TriMesh
    spacing_mm : float

    Returns
    -------
    (N, 3) float64, mm
    float, mm
    """
    corners = mesh.corners()
    gaps = _gaps(corners)
    parts = np.maximum(np.ceil(gaps / spacing_mm), 1.0).astype(np.int64)
    found = [mesh.vertices]
    for count in np.unique(parts):
        a, b = np.divmod(np.arange((count + 1) ** 2), count + 1)
        shares = np.column_stack([a, b, count - a - b])[a + b <= count] / count
        found.append(np.einsum("sk,tkj->tsj", shares, corners[parts == count]).reshape(-1, 3))
    return np.concatenate(found), float((gaps / parts).max(initial=0.0))


_NO_SIDE_MM = 1e-100
"""Stands for a side without length; its square is still above 0."""


def largest_gap(mesh: TriMesh) -> float:
    """How far a place of a surface may be from the nearest corner of its triangle, at most, mm."""
    return float(_gaps(mesh.corners()).max(initial=0.0))


def _gaps(corners: Points) -> Float:
    """(T,) the same for each of (T, 3, 3) triangles."""
    sides = np.sort(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2), axis=1)
    a, b, c = (np.maximum(side, _NO_SIDE_MM) for side in sides.T)
    # Acute: the middle of the circumscribed circle. Obtuse (c the longest side): where the place is as far from the
    # blunt corner as from a sharp one, on the side c.
    cos_a = (b * b + c * c - a * a) / (2.0 * b * c)
    cos_b = (a * a + c * c - b * b) / (2.0 * a * c)
    cos_c = np.clip((a * a + b * b - c * c) / (2.0 * a * b), -1.0, 1.0)
    blunt = cos_c <= 0.0
    on_side = np.maximum(b / (2.0 * np.maximum(cos_a, 1e-12)), a / (2.0 * np.maximum(cos_b, 1e-12)))
    on_side = np.minimum(on_side, c / EDGES_PER_SPACING)
    around = c / (2.0 * np.sqrt(np.maximum(1.0 - cos_c * cos_c, 0.75)))
    gaps: Float = np.where(blunt, on_side, around)
    return gaps
