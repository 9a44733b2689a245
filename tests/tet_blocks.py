"""A block of cubes cut into six tets each, with two tissues, on whole numbers: volumes and midpoints are exact."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.geometry.meshes import TetMesh, TriMesh


def block(cells: tuple[int, int, int], *, edge_mm: float = 1.0) -> TetMesh:
    """Cubes in a row of rows of rows, each cut into the six tets of Kuhn; conforming, right-handed."""
    nx, ny, nz = cells
    number = np.arange((nx + 1) * (ny + 1) * (nz + 1)).reshape(nx + 1, ny + 1, nz + 1)
    places = np.stack(np.meshgrid(*(np.arange(n + 1.0) for n in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    starts = np.stack(np.meshgrid(*(np.arange(n) for n in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    tets = []
    for axes in permutations(range(3)):
        steps = np.cumsum([np.zeros(3, int), *(np.eye(3, dtype=int)[axis] for axis in axes)], axis=0)
        corners = starts[:, None, :] + steps
        tet = number[corners[..., 0], corners[..., 1], corners[..., 2]]
        even = np.linalg.det(np.eye(3)[list(axes)]) > 0
        tets.append(tet if even else tet[:, [0, 2, 1, 3]])
    return TetMesh(edge_mm * places, np.concatenate(tets))


def two_tissues(cells: tuple[int, int, int], *, edge_mm: float = 1.0) -> TetAnatomy:
    """The block as bone where x is small and muscle where it is large."""
    mesh = block(cells, edge_mm=edge_mm)
    half = edge_mm * (cells[0] // 2)
    bone = mesh.vertices[mesh.tets].mean(axis=1)[:, 0] < half
    size = edge_mm * np.array(cells)

    def box(low: float, high: float) -> TriMesh:
        shape = trimesh.creation.box(bounds=[[low, 0, 0], [high, size[1], size[2]]])
        return TriMesh(np.asarray(shape.vertices), np.asarray(shape.faces))

    tissues = (Tissue("muscle", TissueKind.MUSCLE, box(half, size[0])), Tissue("bone", TissueKind.BONE, box(0, half)))
    return TetAnatomy(
        anatomy=Anatomy(tissues, "test, mm"), mesh=mesh, tissue_of_tet=bone.astype(int), dropped=0, findings=()
    )
