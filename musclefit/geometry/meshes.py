"""Triangle and tetrahedral meshes as read-only values; they know indices and positions, not anatomy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Faces, Float, Points, Tets, frozen


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class TriMesh:
    """A triangle surface.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    faces : (f, 3) int64, counter-clockwise seen from outside

    Raises
    ------
    MeshError
        Wrong shapes, indices out of range, or positions that are not finite.
    """

    vertices: Points
    faces: Faces

    def __repr__(self) -> str:
        return f"TriMesh({len(self.vertices)} vertices, {len(self.faces)} triangles)"

    def __post_init__(self) -> None:
        _freeze(self, "faces", corners=3)

    @classmethod
    def together(cls, surfaces: Sequence[TriMesh]) -> TriMesh:
        """Several surfaces as one, their vertices and triangles in order."""
        offsets = np.cumsum([0, *(len(surface.vertices) for surface in surfaces[:-1])])
        return cls(
            np.concatenate([surface.vertices for surface in surfaces]),
            np.concatenate([surface.faces + offset for surface, offset in zip(surfaces, offsets, strict=True)]),
        )

    def with_vertices(self, vertices: Points) -> TriMesh:
        """The same triangles at other positions."""
        return replace(self, vertices=vertices)

    def corners(self) -> Float:
        """(f, 3, 3) positions of each triangle's corners, mm."""
        return self.vertices[self.faces]


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class TetMesh:
    """A tetrahedral mesh.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    tets : (k, 4) int64, right-handed

    Raises
    ------
    MeshError
        Wrong shapes, indices out of range, or positions that are not finite.
    """

    vertices: Points
    tets: Tets

    def __repr__(self) -> str:
        return f"TetMesh({len(self.vertices)} vertices, {len(self.tets)} tetrahedra)"

    def __post_init__(self) -> None:
        _freeze(self, "tets", corners=4)

    def with_vertices(self, vertices: Points) -> TetMesh:
        """The same tetrahedra at other positions."""
        return replace(self, vertices=vertices)


def _freeze(mesh: TriMesh | TetMesh, cells_name: str, *, corners: int) -> None:
    vertices = frozen(mesh.vertices)
    cells = frozen(getattr(mesh, cells_name), np.int64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise MeshError(f"vertices have shape {vertices.shape}; expected (n, 3), in mm")
    if cells.ndim != 2 or cells.shape[1] != corners:
        raise MeshError(f"{cells_name} have shape {cells.shape}; expected (count, {corners})")
    if cells.size and (cells.min() < 0 or cells.max() >= len(vertices)):
        raise MeshError(
            f"{cells_name} refer to vertices {cells.min()} to {cells.max()}, but there are {len(vertices)} (0-based)"
        )
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if bad.size:
        raise MeshError(f"{bad.size} vertices are not finite, the first is number {bad[0]}: {vertices[bad[0]]}")
    object.__setattr__(mesh, "vertices", vertices)
    object.__setattr__(mesh, cells_name, cells)
