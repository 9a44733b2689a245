"""Surfaces broken in every way they come: each is refused with a place, mended and reported, or kept and reported."""

from __future__ import annotations

import re

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.cleaning import require_plausible_size, take_in
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.topology import edges_of

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}


def _ball(subdivisions=2, *, radius=10.0, at=(0.0, 0.0, 0.0)):
    ball = trimesh.creation.icosphere(subdivisions, radius=radius)
    return np.array(ball.vertices) + at, np.array(ball.faces, dtype=np.int64)


def _joined(*surfaces):
    offsets = np.cumsum([0] + [len(v) for v, _ in surfaces[:-1]])
    faces = [f + o for (_, f), o in zip(surfaces, offsets, strict=True)]
    return np.concatenate([v for v, _ in surfaces]), np.concatenate(faces)


def _inwards(surface):
    return surface[0], surface[1][:, ::-1]


def _take_in(surface):
    vertices, faces = surface
    return take_in("ball", TissueKind.MUSCLE, vertices=vertices, faces=faces, source="folder/ball.ply")


def _codes(findings):
    return [finding.code for finding in findings]


VOLUME = trimesh.creation.icosphere(2, radius=10.0).volume


def test_a_whole_surface_goes_through_untouched():
    vertices, faces = _ball()
    tissue, findings = _take_in((vertices, faces))
    assert findings == ()
    assert (tissue.name, tissue.kind) == ("ball", TissueKind.MUSCLE)
    np.testing.assert_array_equal(tissue.surface.vertices, vertices)
    np.testing.assert_array_equal(tissue.surface.faces, faces)


def test_an_open_surface_is_refused_with_its_hole_and_a_way_out():
    vertices, faces = _ball(at=(100, 0, 0))
    top = np.argmax(vertices[:, 2])
    with pytest.raises(MeshError) as caught:
        _take_in((vertices, faces[~(faces == top).any(axis=1)]))
    message = str(caught.value)
    assert message.startswith("folder/ball.ply: tissue 'ball' is not closed: ")
    around = int((faces == top).any(axis=1).sum())
    assert f"{around} boundary edges around 1 hole, the largest with {around} edges near (" in message
    place = [float(v) for v in re.search(r"near \((.*?)\) mm", message)[1].split(",")]
    assert np.linalg.norm(np.array(place) - vertices[top]) < 2.0
    assert "Close it with musclefit repair IN OUT, which fills holes" in message


def test_two_holes_are_counted():
    vertices, faces = _ball()
    far = next(i for i in range(1, len(faces)) if not set(faces[i]) & set(faces[0]))
    with pytest.raises(MeshError, match="6 boundary edges around 2 holes, the largest with 3 edges"):
        _take_in((vertices, np.delete(faces, [0, far], axis=0)))


def test_an_edge_of_three_closed_sheets_is_refused():
    # three half discs of a pair of tetrahedra: two chambers with a common wall
    vertices = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4], [0, 0, -4]])
    upper = [[0, 1, 3], [1, 2, 3], [2, 0, 3]]
    lower = [[1, 0, 4], [2, 1, 4], [0, 2, 4]]
    with pytest.raises(MeshError, match="3 edges with three or another odd number of faces, one near"):
        _take_in((vertices, np.array([*upper, *lower, [0, 2, 1]])))


def test_a_triangle_soup_is_merged_and_said_so():
    vertices, faces = _ball()
    tissue, findings = _take_in((vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)))
    assert _codes(findings) == ["merged-vertices"]
    assert f"merged {faces.size - len(vertices)} of {faces.size} vertices" in findings[0].message
    assert len(tissue.surface.vertices) == len(vertices)
    np.testing.assert_allclose(enclosed_volume(tissue.surface), VOLUME, rtol=1e-12)


def test_vertices_that_nearly_coincide_are_not_merged():
    vertices, faces = _ball()
    soup = vertices[faces].reshape(-1, 3)
    soup[7] = np.nextafter(soup[7], 1e3)
    with pytest.raises(MeshError, match="is not closed"):
        _take_in((soup, np.arange(faces.size).reshape(-1, 3)))


def test_a_closed_surface_that_touches_itself_keeps_its_vertices():
    left, right = _ball(1), _ball(1)
    tip = left[0][np.argmax(left[0][:, 0])]
    mirrored = right[0] * [-1, 1, 1] + 2 * tip * [1, 0, 0]
    vertices, faces = _joined(left, (mirrored, right[1][:, ::-1]))
    tissue, findings = _take_in((vertices, faces))
    assert len(tissue.surface.vertices) == len(vertices)
    assert _codes(findings) == ["pieces", "self-touching"]
    assert "1 vertex at the position of another" in findings[1].message


@pytest.mark.parametrize("turned", [[3], [3, 50, 51, 200]])
def test_faces_that_disagree_are_turned(turned):
    vertices, faces = _ball()
    broken = faces.copy()
    broken[turned] = broken[turned][:, ::-1]
    tissue, findings = _take_in((vertices, broken))
    assert _codes(findings) == ["turned-faces"]
    assert f"turned {len(turned)} of {len(faces)} faces" in findings[0].message
    np.testing.assert_array_equal(tissue.surface.faces, faces)


def test_an_inside_out_surface_is_turned():
    tissue, findings = _take_in(_inwards(_ball()))
    assert _codes(findings) == ["inside-out"]
    assert "the surface was inside-out (enclosing -" in findings[0].message
    np.testing.assert_allclose(enclosed_volume(tissue.surface), VOLUME, rtol=1e-12)


def test_an_inside_out_surface_with_most_faces_turned_comes_out_right():
    vertices, faces = _ball()
    broken = faces[:, ::-1].copy()
    broken[:40] = faces[:40]
    tissue, findings = _take_in((vertices, broken))
    assert _codes(findings) == ["turned-faces", "inside-out"]
    np.testing.assert_array_equal(tissue.surface.faces, faces)


def test_a_cavity_stays_a_cavity():
    shell, hollow = _ball(), _ball(radius=5)
    tissue, findings = _take_in(_joined(shell, _inwards(hollow)))
    assert _codes(findings) == ["cavities"]
    np.testing.assert_allclose(enclosed_volume(tissue.surface), VOLUME * (1 - 1 / 8), rtol=1e-12)


def test_an_inside_out_shell_takes_its_cavity_along():
    shell, hollow = _ball(), _ball(radius=5)
    tissue, findings = _take_in(_joined(_inwards(shell), hollow))
    assert _codes(findings) == ["inside-out", "cavities"]
    np.testing.assert_allclose(enclosed_volume(tissue.surface), VOLUME * (1 - 1 / 8), rtol=1e-12)


def test_a_shell_inside_turned_outwards_too_is_reported_and_kept():
    tissue, findings = _take_in(_joined(_ball(), _ball(radius=5)))
    assert _codes(findings) == ["nested"]
    assert "their volume counts twice" in findings[0].message
    np.testing.assert_allclose(enclosed_volume(tissue.surface), VOLUME * (1 + 1 / 8), rtol=1e-12)


def test_one_of_two_pieces_inside_out_is_turned_alone():
    tissue, findings = _take_in(_joined(_ball(), _inwards(_ball(at=(30, 0, 0)))))
    assert _codes(findings) == ["inside-out", "pieces"]
    assert "1 of 2 pieces were" in findings[0].message
    np.testing.assert_allclose(enclosed_volume(tissue.surface), 2 * VOLUME, rtol=1e-12)


def test_faces_that_bound_nothing_are_left_out():
    vertices, faces = _ball()
    tissue, findings = _take_in((vertices, np.vstack([faces, faces[7:8], [[4, 4, 9]]])))
    assert _codes(findings) == ["repeated-vertices", "repeated-faces"]
    np.testing.assert_array_equal(tissue.surface.faces, faces)


def test_a_face_without_area_is_kept_and_reported():
    vertices, faces = _ball()
    a, b, c = faces[0]
    middle = len(vertices)
    vertices = np.vstack([vertices, 0.5 * (vertices[a] + vertices[b])])
    split = np.vstack([faces[1:], [[a, middle, c], [middle, b, c], [a, b, middle]]])
    vertices[[a, b]] = [[8.0, 0, 0], [8.0, 2, 0]]
    vertices[middle] = [8.0, 1, 0]
    tissue, findings = _take_in((vertices, split))
    assert "zero-area" in _codes(findings)
    assert len(tissue.surface.faces) == len(split)


def test_a_shared_edge_of_two_bodies_is_reported():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, 0.3, 1], [0.5, -1, 0], [0.5, -0.3, -1]])
    first, second = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], [[0, 1, 4], [1, 0, 5], [4, 1, 5], [0, 4, 5]]
    one = enclosed_volume(TriMesh(10 * vertices, np.array(first)))
    tissue, findings = _take_in((10 * vertices, np.array(first + second)))
    assert _codes(findings) == ["inside-out", "pieces", "non-manifold"]
    assert "1 edge with more than two faces" in findings[2].message
    assert not len(edges_of(tissue.surface.faces).unbalanced)
    np.testing.assert_allclose(enclosed_volume(tissue.surface), 2 * one, rtol=1e-12)


def test_a_body_pinched_to_an_edge_is_one_piece():
    # a ball whose one edge is merged with an edge of the far side: four faces at it, no part closed by itself
    vertices, faces = _ball()
    a, b = faces[0][:2]
    far = faces[np.argmax(np.linalg.norm(vertices[faces].mean(axis=1) - vertices[faces[0]].mean(axis=0), axis=1))]
    merged = np.arange(len(vertices))
    merged[far[0]], merged[far[1]] = b, a
    _, findings = _take_in((vertices, merged[faces]))
    assert "non-manifold" in _codes(findings)
    assert "pieces" not in _codes(findings)


def test_a_crossing_is_reported_with_number_and_place():
    vertices, faces = _ball()
    top = np.argmax(vertices[:, 2])
    vertices[top, 2] = -15.0
    tissue, findings = _take_in((vertices, faces))
    assert _codes(findings) == ["self-crossing"]
    found = re.search(
        r"(\d+) pairs of triangles of this surface cross, the first near \((.*?)\) mm", findings[0].message
    )
    assert int(found[1]) > 0
    place = np.array([float(v) for v in found[2].split(",")])
    assert np.linalg.norm(place - [0, 0, -10]) < 4.0
    np.testing.assert_array_equal(tissue.surface.vertices, vertices)


def test_unused_vertices_are_reported_and_kept():
    vertices, faces = _ball()
    tissue, findings = _take_in((np.vstack([vertices, [[0.0, 0, 0]]]), faces))
    assert _codes(findings) == ["unused-vertices"]
    assert len(tissue.surface.vertices) == len(vertices) + 1


def test_a_klein_bottle_has_no_inside():
    n = 8
    index = np.arange(n * n).reshape(n, n)
    right = np.roll(index, -1, axis=1)
    up, up_right = np.roll(index, -1, axis=0), np.roll(right, -1, axis=0)
    up[-1], up_right[-1] = index[0, ::-1], np.roll(index[0, ::-1], -1)
    faces = np.concatenate(
        [np.stack([index, right, up], 2).reshape(-1, 3), np.stack([right, up_right, up], 2).reshape(-1, 3)]
    )
    vertices = np.random.default_rng(0).uniform(-10, 10, (n * n, 3))
    with pytest.raises(MeshError, match="has no inside: 128 of its 128 faces form a one-sided surface"):
        _take_in((vertices, faces))


def test_two_sheets_on_each_other_enclose_nothing():
    vertices, faces = _ball()
    disc = faces[(vertices[faces][:, :, 2] > 0).all(axis=1)]
    doubled = _joined((vertices, disc), (vertices, disc[:, ::-1]))
    with pytest.raises(MeshError, match="encloses no volume"):
        _take_in(doubled)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, f: (v[:0], f[:0]), r"folder/ball.ply: an empty surface \(0 vertices, 0 faces\)"),
        (lambda v, f: (v, f[:0]), "an empty surface .* 0 faces"),
        (
            lambda v, f: (np.vstack([v[:17], [[1.0, np.nan, 2.0]], v[18:]]), f),
            r"the first is number 17 \(0-based\): \(1, nan, 2\)",
        ),
        (lambda v, f: (np.vstack([v[:3], [[np.inf, 0, 0]], v[4:]]), f), "1 of 162 vertices are not finite"),
        (
            lambda v, f: (np.vstack([v[:3], [[0, -3e200, 0]], v[4:]]), f),
            r"vertex 3 .* is at \(0, -3e\+200, 0\) mm, farther",
        ),
        (lambda v, f: (v, f + 1), "uses vertex 162, but there are 162"),
        (lambda v, f: (v, f - 1), "uses vertex -1"),
        (lambda v, _: (v[:3], np.array([[0, 1, 2], [2, 1, 0]])), "has 2 faces; a closed surface has at least 4"),
    ],
)
def test_numbers_that_cannot_be(change, message):
    with pytest.raises(MeshError, match=message):
        _take_in(change(*_ball()))


def _tissues(scale):
    tissue, _ = _take_in(_ball(radius=225.0))
    return [tissue.with_vertices(tissue.surface.vertices * scale)]


@pytest.mark.parametrize(
    ("scale", "read_in", "message"),
    [
        (
            1e-3,
            "mm",
            r'the anatomy is 0.779 mm across; the files look like metres, set units = "m"',
        ),
        (1e3, "m", r'the anatomy is 7.* mm across; the files look like millimetres, set units = "mm"'),
        (10.0, "cm", r'look like millimetres, set units = "mm"'),
        (1e-9, "mm", "no unit musclefit reads .mm, cm, m. puts it between 5 and 5000 mm"),
    ],
)
def test_implausible_sizes(scale, read_in, message):
    with pytest.raises(InputError, match=message):
        require_plausible_size(_tissues(scale), units=UNITS, read_in=read_in)


def test_a_plausible_size_passes_in_any_unit():
    for unit in UNITS:
        require_plausible_size(_tissues(1.0), units=UNITS, read_in=unit)


def test_small_parts_of_a_large_anatomy_pass():
    small = TriMesh(*_ball(radius=0.1))
    tissues = [*_tissues(1.0), _tissues(1.0)[0].with_vertices(small.vertices)]
    require_plausible_size(tissues, units=UNITS, read_in="mm")
