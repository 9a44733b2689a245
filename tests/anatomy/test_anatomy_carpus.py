"""Seven bones of a real wrist, gaps of 0.4 mm between them, in a box: true to volume, and finer where they meet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from musclefit.anatomy.mesh_rules import FILLER, Gaps, LayerRules, gap_widths
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.tets.topology import tet_edges, tet_faces
from musclefit.io.anatomy import read_anatomy
from musclefit.meshing.ftetwild import tetrahedralise
from musclefit.progress import Silent

BONES = ("capitate", "hamate", "lunate", "scaphoid", "trapezium", "trapezoid", "triquetral")
RULES = LayerRules(edge_length_fraction=0.06, envelope_fraction=7e-4, gap_edge_mm=1.0, gap_ratio=2.0)


@pytest.fixture(scope="module")
def wrist(anatomy_data: Path) -> Anatomy:
    folder = anatomy_data / "arm" / "disjoint"
    files = [path for path in folder.glob("bone_right_*.ply") if any(f"right_{bone}_" in path.name for bone in BONES)]
    bones = read_anatomy(files, progress=Silent()).anatomy
    assert len(bones) == len(BONES)
    corners = bones.vertices()
    around = trimesh.creation.box(bounds=[corners.min(axis=0) - 4, corners.max(axis=0) + 4]).subdivide().subdivide()
    skin = Tissue("skin", TissueKind.SKIN, TriMesh(np.asarray(around.vertices), np.asarray(around.faces)))
    return Anatomy((skin, *bones), bones.frame)


def median_edge_in_gaps(tets: TetAnatomy, wrist: Anatomy) -> float:
    """Of the edges whose ends both lie where a bone is nearer than 1 mm to another, mm."""
    widths = gap_widths(wrist, gaps=Gaps.JOINTS, up_to_mm=1.0)
    narrow = np.concatenate([wrist[name].surface.vertices[np.isfinite(width)] for name, width in widths.items()])
    edges, _ = tet_edges(tets.mesh.tets)
    near = cKDTree(narrow).query(tets.mesh.vertices)[0] < 0.5
    inside = edges[near[edges].all(axis=1)]
    return float(np.median(np.linalg.norm(np.diff(tets.mesh.vertices[inside], axis=1), axis=2)))


@pytest.mark.slow
@pytest.mark.anatomy
def test_a_wrist_is_meshed_conformingly_and_finer_in_its_joints(wrist: Anatomy) -> None:
    plain = tetrahedralise(wrist, RULES, progress=Silent())
    fine = tetrahedralise(wrist, replace(RULES, gaps=Gaps.JOINTS), progress=Silent())
    for tets in (plain, fine):
        assert tets.findings == ()
        assert len(tet_faces(tets.mesh.tets).odd) == 0
        assert all(fit.pieces == 1 for fit in tets.fits if fit.name != FILLER)
        errors = [fit.volume_error_percent for fit in tets.fits if fit.volume_error_percent is not None]
        assert np.abs(errors).max() < 2.0
        print(len(tets.mesh.tets), np.abs(errors).max(), median_edge_in_gaps(tets, wrist))
    assert median_edge_in_gaps(fine, wrist) < 0.8 * median_edge_in_gaps(plain, wrist)
