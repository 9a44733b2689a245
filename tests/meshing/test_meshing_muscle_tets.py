"""Meshing one muscle: when a mesh is made again with a narrower envelope, and what is told of the last."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
import trimesh
from tet_blocks import block
from tiny_rigs import egg

import musclefit as mf
from musclefit.anatomy.mesh_fidelity import TissueFit, piece_of_tet
from musclefit.anatomy.mesh_rules import LayerRules
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.surfaces.booleans import united
from musclefit.geometry.surfaces.sections import sections_along
from musclefit.geometry.tets.topology import tet_faces
from musclefit.meshing import cache
from musclefit.meshing import muscle_tets as muscle_tets_module
from musclefit.meshing.cache import TetCache
from musclefit.meshing.muscle_tets import (
    NECK_ENVELOPES,
    MuscleTets,
    loose_share,
    muscle_tets,
    shared_vertices,
    with_wider_necks,
)
from musclefit.progress import Silent

MUSCLE = Tissue("muscle", TissueKind.MUSCLE, egg((0, 0, 0), (25, 5, 5)))
WHOLE = block((6, 4, 4))
VOLUME = 96.0


def with_a_tet_beside(mesh: TetMesh, size: float) -> TetMesh:
    """One more, with a corner at the block's, and no face in common: its volume is a sixth of the size's cube."""
    count = len(mesh.vertices)
    corner = int(np.abs(mesh.vertices).sum(axis=1).argmin())
    vertices = np.vstack([mesh.vertices, -size * np.eye(3)[[1, 0, 2]]])
    return TetMesh(vertices, np.vstack([mesh.tets, [[corner, count, count + 1, count + 2]]]))


Making = Callable[..., TetAnatomy]
MESHES = MappingProxyType(
    {"whole": WHOLE, "pinched": with_a_tet_beside(WHOLE, 0.5), "apart": with_a_tet_beside(WHOLE, 2.0)}
)


def meshed(tries: list[tuple[str, float]], monkeypatch: pytest.MonkeyPatch, folder: Path) -> tuple[MuscleTets, list]:
    """What comes of tries that give such meshes and miss so many envelopes; and the rules and passes of each."""
    asked: list[tuple[LayerRules, int]] = []

    def made(anatomy: Anatomy, rules: LayerRules, *, passes: int, progress: object) -> TetAnatomy:
        kind, missed = tries[len(asked)]
        asked.append((rules, passes))
        mesh = MESHES[kind]
        envelope = asked[0][0].smallest_envelope(anatomy) * np.linalg.norm(np.ptp(anatomy.vertices(), axis=0))
        fit = TissueFit(
            "muscle", "muscle", len(mesh.tets), VOLUME, VOLUME, VOLUME, missed_mm=missed * envelope,
            pieces=1 + (kind != "whole"), surface_pieces=1,
        )  # fmt: skip
        return TetAnatomy(anatomy, mesh, np.zeros(len(mesh.tets), dtype=np.int64), 0, (), (fit,))

    monkeypatch.setattr(cache, "tetrahedralise", made)
    found = muscle_tets(
        MUSCLE, TetCache(folder, limit_mb=0.0), sections=sections_along(MUSCLE.surface), progress=Silent()
    )
    assert len(asked) == len(tries)
    return found, asked


@pytest.mark.parametrize(
    ("tries", "pieces"),
    [
        ([("whole", 0.6)], 1),
        ([("whole", 4.0), ("whole", 0.2)], 1),
        ([("whole", 4.0), ("whole", 4.0)], 1),
        ([("apart", 0.6), ("whole", 0.6)], 1),
        ([("apart", 0.6), ("apart", 0.6)], 2),
        ([("pinched", 0.6), ("whole", 0.2)], 1),
        ([("pinched", 4.0), ("pinched", 0.2)], 2),
    ],
)
def test_a_mesh_is_made_again_once_where_it_falls_apart_or_misses_an_end(
    tries: list[tuple[str, float]], pieces: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found, asked = meshed(tries, monkeypatch, tmp_path)
    envelopes = [rules.envelope_fraction for rules, _ in asked]
    np.testing.assert_allclose(envelopes, [envelopes[0], envelopes[0] / 4.0][: len(asked)], rtol=1e-12)
    assert {passes for _, passes in asked} == {1}
    assert found.pieces == pieces
    assert found.whole == (tries[-1] in [("whole", 0.6), ("whole", 0.2)])


def test_what_is_added_at_a_neck_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Half of a ball at the egg's tip, nothing of one at its middle."""
    for place, added in (((25.0, 0.0, 0.0), True), ((0.0, 0.0, 0.0), False)):
        monkeypatch.setattr(muscle_tets_module, "shared_vertices", lambda *_, at=place: np.array([at]))
        found, _ = meshed([("pinched", 0.6), ("whole", 0.2)], monkeypatch, tmp_path)
        ball = 4.0 / 3.0 * np.pi * (NECK_ENVELOPES * found.first_envelope_mm) ** 3
        low, high = (0.3, 1.0) if added else (-1e-6, 1e-6)
        assert low < found.widened_mm3 / ball < high


def pieces_of(mesh: TetMesh) -> np.ndarray:
    return piece_of_tet(tet_faces(mesh.tets), inside=np.ones(len(mesh.tets), dtype=bool))


def test_the_loose_share_is_that_of_all_pieces_but_the_largest() -> None:
    assert loose_share(WHOLE, pieces_of(WHOLE)) == 0.0
    for kind, size in (("pinched", 0.5), ("apart", 2.0)):
        own = size**3 / 6.0
        assert loose_share(MESHES[kind], pieces_of(MESHES[kind])) == pytest.approx(own / (VOLUME + own), rel=1e-12)


def test_pieces_share_the_corner_at_which_they_touch() -> None:
    assert not len(shared_vertices(WHOLE, pieces_of(WHOLE)))
    np.testing.assert_array_equal(shared_vertices(MESHES["apart"], pieces_of(MESHES["apart"])), [[0.0, 0.0, 0.0]])


NECK_MM = 0.004


def dumbbell() -> TriMesh:
    """Two bars of 6 by 4 by 4 mm, end to end, that a prism of a few thousandths of a mm joins."""
    parts = [
        trimesh.creation.box(bounds=bounds)
        for bounds in (
            [(-6.2, -2, -2), (-0.2, 2, 2)],
            [(0.2, -2, -2), (6.2, 2, 2)],
            [(-0.3, -NECK_MM, -NECK_MM), (0.3, NECK_MM, NECK_MM)],
        )
    ]
    return united([TriMesh(np.array(p.vertices), np.array(p.faces)) for p in parts], smooth_within_mm=0.0)


@pytest.mark.slow
@pytest.mark.anatomy
def test_a_tendon_with_a_neck_of_a_few_thousandths_of_a_mm_is_one_piece(
    anatomy_data: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Flexor pollicis longus of a real forearm, whose tip hangs on by an edge: 20 s of CPU time."""
    monkeypatch.setenv("MUSCLEFIT_DATA", str(anatomy_data))
    monkeypatch.setenv("MUSCLEFIT_CACHE", str(tmp_path))
    found = mf.architecture("forearm_rigid", muscles=["*flexor_pollicis_longus*"], within_mm=1.27, deform=False)
    assert [muscle.pieces for muscle in found.muscles] == [1]
    assert "mm³ were added at necks" in found.muscles[0].note
    assert len(list(tmp_path.glob("tets-*.npz"))) == 2, "the first mesh was in one piece: choose another muscle"


def test_balls_change_a_surface_nowhere_else() -> None:
    thin, radius = dumbbell(), 0.5
    wide = with_wider_necks(thin, np.zeros((1, 3)), radius_mm=radius)
    away = np.linalg.norm(wide.vertices, axis=1) > radius + 1e-9
    assert set(map(tuple, wide.vertices[away])) == set(
        map(tuple, thin.vertices[np.linalg.norm(thin.vertices, axis=1) > radius])
    )
    room = 0.5236 * radius**3 * 8.0
    assert 0.1 * room < enclosed_volume(wide) - enclosed_volume(thin) < room
    assert with_wider_necks(thin, np.zeros((0, 3)), radius_mm=radius) is thin


def test_a_surface_that_bounds_no_solid_keeps_its_necks() -> None:
    cut = TriMesh(MUSCLE.surface.vertices, MUSCLE.surface.faces[1:])
    assert with_wider_necks(cut, np.zeros((1, 3)), radius_mm=1.0) is cut
