"""Cross-sections of a long closed surface that ride along when its vertices move: centreline and section areas."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy.sparse import coo_array, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Float, Int, Points, frozen
from musclefit.geometry.meshes import TriMesh

SECTIONS = 40
"""Sections of a surface, at even steps of its area."""

_SHIFT = -1e-8
"""Where eigenvalues are looked for, as a share of the inverse area: just below the smallest, which is 0."""


@dataclass(frozen=True, eq=False, slots=True)
class Sections:
    """Closed curves around a surface, one after the other along it; made by `sections_along`.

    Each curve is made of segments between points on edges of the surface, so that it moves with the surface's vertices.

    Parameters
    ----------
    edges : (p, 2) int64
        The edge that each point stands on, as vertex numbers.
    weights : (p,) float64
        How far along its edge, in [0, 1].
    segments : (s, 2) int64
        Points joined, so that the curve turns counter-clockwise seen from the far end.
    section : (s,) int64
        The curve that each segment belongs to, rising from 0.
    ends : (2,) int64
        The vertices where the surface begins and ends.
    """

    edges: Int
    weights: Float
    segments: Int
    section: Int
    ends: Int

    def __post_init__(self) -> None:
        for name in ("edges", "segments", "section", "ends"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.int64))
        object.__setattr__(self, "weights", frozen(self.weights))

    @property
    def vertices(self) -> Int:
        """(u,) the numbers, rising, of the vertices that `measure` looks at."""
        found: Int = np.unique(np.concatenate([self.edges.ravel(), self.ends]))
        return found

    def measure(self, vertices: Points) -> SectionMeasures:
        r"""Centreline and section areas with the surface's vertices at (n, 3) places, mm.

        The area vector of a curve is :math:`\tfrac12 \sum (p - c) \times (q - c)` over its segments pq. The area across
        is its part along the centreline, which undoes the slant of a section: exact for slanted sections of a cylinder.
        """
        count = int(self.section[-1]) + 1
        first, second = (vertices[self.edges[:, k]] for k in (0, 1))
        points = first + self.weights[:, None] * (second - first)
        p, q = points[self.segments[:, 0]], points[self.segments[:, 1]]
        middles = _sums(0.5 * (p + q), self.section, count) / np.bincount(self.section, minlength=count)[:, None]
        c = middles[self.section]
        parts = 0.5 * np.cross(p - c, q - c)
        areas = _sums(parts, self.section, count)
        sizes = np.linalg.norm(areas, axis=1)
        normals = areas / np.where(sizes > 0.0, sizes, 1.0)[:, None]
        shares = np.einsum("si,si->s", parts, normals[self.section])
        moments = _sums(shares[:, None] * (p + q - 2.0 * c) / 3.0, self.section, count)
        centres = middles + moments / np.where(sizes > 0.0, sizes, 1.0)[:, None]
        line = np.vstack([vertices[self.ends[0]], centres, vertices[self.ends[1]]])
        along = line[2:] - line[:-2]
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        return SectionMeasures(line, np.abs(np.einsum("si,si->s", areas, along)))


@dataclass(frozen=True, eq=False, slots=True)
class SectionMeasures:
    """A surface in one place.

    Parameters
    ----------
    centreline : (k + 2, 3) float64, mm
        From end to end through the centres of the k sections.
    areas : (k,) float64, mm²
        Of the sections, across the centreline.
    """

    centreline: Points
    areas: Float

    @property
    def length(self) -> float:
        """Of the centreline, mm."""
        return float(np.linalg.norm(np.diff(self.centreline, axis=0), axis=1).sum())

    @property
    def largest_area(self) -> float:
        """The largest section, mm²."""
        return float(self.areas.max())


@dataclass(frozen=True, eq=False, slots=True)
class Lengthwise:
    """A surface along its length, at rest.

    Parameters
    ----------
    sections : Sections
    position : (n,) float64
        For each vertex the share of the surface's area that lies before it, 0 to 1.
    along : (n,) float64
        The function that rises from end to end, of which the sections are level curves.
    """

    sections: Sections
    position: Float
    along: Float

    @classmethod
    def of(cls, surface: TriMesh) -> Lengthwise:
        """`sections_along` and `position_by`, for which the one eigenfunction is found once.

        Raises
        ------
        MeshError
            The surface has no area.
        """
        along = _along(surface)
        return cls(_sections(surface, along, count=SECTIONS), position_by(surface, along), along)


def sections_along(surface: TriMesh, *, count: int = SECTIONS) -> Sections:
    """Cut a closed surface along its length.

    The cuts are level curves of the lowest eigenfunction of the surface's Laplacian, which runs from end to end of
    anything long, however bent; of a surface in several pieces, level planes of its longest principal axis.

    Parameters
    ----------
    surface : TriMesh
    count : int
        Sections, each at an even step of the surface's area.

    Raises
    ------
    MeshError
        A surface without area.

    References
    ----------
    B. Lévy, Laplace-Beltrami eigenfunctions: towards an algorithm that understands geometry, SMI 2006.
    """
    return _sections(surface, _along(surface), count=count)


def _sections(surface: TriMesh, along: Float, *, count: int) -> Sections:
    order = np.argsort(along)
    area = np.zeros(len(along))
    np.add.at(area, surface.faces, (_face_areas(surface) / 3.0)[:, None])
    covered = np.cumsum(area[order])
    at = np.searchsorted(covered, (np.arange(count) + 0.5) / count * covered[-1])
    levels = np.unique(0.5 * (along[order[at]] + along[order[np.minimum(at + 1, len(order) - 1)]]))
    edges: list[Int] = []
    weights: list[Float] = []
    segments: list[Int] = []
    section: list[Int] = []
    points = 0
    corners = [along[surface.faces[:, k]] for k in range(3)]
    lowest, highest = np.minimum.reduce(corners), np.maximum.reduce(corners)
    for level in levels:
        above = along > level
        crossed = surface.faces[(highest > level) & (lowest <= level)]
        if not len(crossed):
            continue
        ends, pairs = level_curve(crossed, above)
        here = np.unique(ends, axis=0)
        low, high = along[here[:, 0]], along[here[:, 1]]
        edges.append(here)
        weights.append((level - low) / (high - low))
        segments.append(pairs + points)
        section.append(np.full(len(pairs), len(section)))
        points += len(here)
    used = np.flatnonzero(area > 0.0)
    tips = used[[np.argmin(along[used]), np.argmax(along[used])]]
    return Sections(
        np.concatenate(edges), np.concatenate(weights), np.concatenate(segments), np.concatenate(section), tips
    )


def position_along(surface: TriMesh) -> Float:
    """(n,) for each vertex the share of the surface's area that lies before it along its length, 0 to 1.

    Raises
    ------
    MeshError
        A surface without area.
    """
    return position_by(surface, _along(surface))


def position_by(surface: TriMesh, along: Float) -> Float:
    """(n,) the share of a surface's area at vertices where a function is smaller; ``along`` (n,) is the function."""
    area = np.zeros(len(along))
    np.add.at(area, surface.faces, (_face_areas(surface) / 3.0)[:, None])
    order = np.argsort(along)
    position = np.empty(len(along))
    position[order] = np.cumsum(area[order]) / area.sum()
    return position


def level_curve(crossed: Int, above: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> tuple[Int, Int]:
    """Edges that a level crosses, two of each face in row, and (s, 2) segments between their unique numbers."""
    alone_above = above[crossed].sum(axis=1) == 1
    corner = np.where(alone_above, above[crossed].argmax(axis=1), (~above[crossed]).argmax(axis=1))
    rows = np.arange(len(crossed))
    tip, after, before = (crossed[rows, (corner + k) % 3] for k in (0, 1, 2))
    one, two = np.sort(np.stack([tip, after], axis=1), axis=1), np.sort(np.stack([before, tip], axis=1), axis=1)
    forward = alone_above[:, None]
    ends = np.stack([np.where(forward, one, two), np.where(forward, two, one)], axis=1).reshape(-1, 2)
    _, numbers = np.unique(ends, axis=0, return_inverse=True)
    return ends, numbers.reshape(-1, 2).astype(np.int64)


def _along(surface: TriMesh) -> Float:
    """A value at each vertex that rises from one end of the surface to the other."""
    vertices, faces = surface.vertices, surface.faces
    total = float(_face_areas(surface).sum())
    if not total > 0.0:
        raise MeshError("a surface without area has no sections; give a closed surface")
    used, inner = np.unique(faces, return_inverse=True)
    inner = inner.reshape(-1, 3)
    n = len(used)
    links = coo_array((np.ones(inner.size), (inner.ravel(), np.roll(inner, 1, axis=1).ravel())), shape=(n, n))
    pieces, _ = connected_components(links, directed=False)
    values = np.zeros(len(vertices))
    if pieces > 1:
        centred = vertices[used] - vertices[used].mean(axis=0)
        values[used] = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    else:
        places, corners = np.array(vertices[used]), np.array(inner)
        stiffness = -csr_matrix(igl.cotmatrix(places, corners))
        mass = csr_matrix(igl.massmatrix(places, corners, igl.MASSMATRIX_TYPE_BARYCENTRIC))
        start = places @ np.linalg.svd(places - places.mean(axis=0), full_matrices=False)[2][0]
        found = eigsh(stiffness, k=2, M=mass, sigma=_SHIFT / total, v0=start - start.mean() + 1e-3 * np.ptp(start))
        values[used] = found[1][:, np.argsort(found[0])[1]]
    # the sense that points to the larger coordinates, so that it does not depend on the solver
    sense = np.sign((values[used] - values[used].mean()) @ (vertices[used].sum(axis=1)))
    return values * (sense if sense != 0.0 else 1.0)


def _face_areas(surface: TriMesh) -> Float:
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    areas: Float = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return areas


def _sums(values: Points, group: Int, count: int) -> Points:
    return np.stack([np.bincount(group, weights=column, minlength=count) for column in values.T], axis=1)
