"""How often a surface winds around the space outside its sheets: nested balls, pressed together, far away, on edges."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.sheet_winding import UNKNOWN, sheets_of


def ball(radius: float, centre: tuple[float, float, float] = (0, 0, 0), *, inside_out: bool = False) -> TriMesh:
    shape = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    faces = np.asarray(shape.faces)
    return TriMesh(np.asarray(shape.vertices) + centre, faces[:, ::-1] if inside_out else faces)


def together(*meshes: TriMesh) -> TriMesh:
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return TriMesh(
        np.vstack([m.vertices for m in meshes]),
        np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=False)]),
    )


def windings(mesh: TriMesh) -> list[int]:
    return sorted(sheets_of(mesh).outside.tolist())


def test_a_ball_is_alone() -> None:
    assert windings(ball(1.0)) == [0]


def test_a_void_in_a_ball_is_no_cover_and_a_body_in_it_is() -> None:
    assert windings(together(ball(3.0), ball(1.0, inside_out=True))) == [0, 0]
    assert windings(together(ball(3.0), ball(1.0))) == [0, 1]
    assert windings(together(ball(3.0), ball(2.0, inside_out=True), ball(1.0))) == [0, 0, 0]
    assert windings(together(ball(4.0), ball(2.0), ball(1.0))) == [0, 1, 2]


def test_bodies_side_by_side_are_alone() -> None:
    assert windings(together(ball(1.0), ball(1.0, (2.5, 0, 0)), ball(1.0, (0, 2.5, 0)))) == [0, 0, 0]


def test_a_mirrored_ball_has_minus_one_outside() -> None:
    assert windings(ball(1.0, inside_out=True)) == [-1]


def test_sheets_that_meet_at_an_edge_are_apart() -> None:
    boxes = [trimesh.creation.box(bounds=b) for b in ([[0, 0, 0], [1, 1, 1]], [[1, 1, 0], [2, 2, 1]])]
    joined = trimesh.util.concatenate(boxes)
    joined.merge_vertices()
    found = sheets_of(TriMesh(np.asarray(joined.vertices), np.asarray(joined.faces)))
    assert found.outside.tolist() == [0, 0]
    assert len(np.unique(found.of_face)) == 2


def test_rays_that_meet_edges_are_left_for_others() -> None:
    """Boxes of the same size behind each other: the first rays run into the diagonals of the faces behind."""
    shapes = [trimesh.creation.box(bounds=[[3 * k, 0, 0], [3 * k + 1, 1, 1]]) for k in range(3)]
    meshes = [TriMesh(np.asarray(s.vertices), np.asarray(s.faces)) for s in shapes]
    assert windings(together(*meshes)) == [0, 0, 0]


def test_a_face_on_another_is_unknown() -> None:
    assert set(sheets_of(together(ball(1.0), ball(1.0, inside_out=True))).outside.tolist()) == {UNKNOWN}


@pytest.mark.parametrize("offset", [0.0, 1e-9, 1e6])
@settings(max_examples=12)
@given(numbers=st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9))
def test_a_nested_ball_is_found_however_space_is_turned_and_shifted(offset: float, numbers: list[float]) -> None:
    turn, _ = np.linalg.qr(np.array(numbers).reshape(3, 3) + 3.0 * np.eye(3))
    turn *= np.sign(np.linalg.det(turn))
    mesh = together(ball(3.0), ball(1.0, (0.7, 0.2, -0.1)))
    moved = mesh.with_vertices(mesh.vertices @ turn.T + offset)
    assert windings(moved) == [0, 1]
