"""Attacks on the certificate of tet meshes: what overlaps, crosses, touches or is inverted by one ulp is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tet_blocks import block

from musclefit.certify.meshes import certify_mesh
from musclefit.certify.model import MeshCertificate
from musclefit.errors import MeshError
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.meshes import TetMesh
from musclefit.geometry.tets.orientation import orientations
from musclefit.vocabulary import Claim


def bent_bar(degrees: float, *, cells: int = 24) -> TetMesh:
    """A long bar bent into a ring: beyond 360 degrees its ends collide, though no tet is inverted."""
    bar = block((cells, 2, 2))
    angle = np.radians(degrees) * bar.vertices[:, 0] / cells
    radius = cells / np.radians(degrees) + bar.vertices[:, 1]
    # one end is lifted by less than the bar's height, so that the ends overlap without the same corners
    lift = bar.vertices[:, 2] + 0.37 * bar.vertices[:, 0] / cells
    return bar.with_vertices(np.stack([radius * np.sin(angle), -radius * np.cos(angle), lift], axis=1)[:, [1, 0, 2]])


def together(*meshes: TetMesh) -> TetMesh:
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return TetMesh(
        np.vstack([m.vertices for m in meshes]),
        np.concatenate([m.tets + start for m, start in zip(meshes, starts, strict=False)]),
    )


def moved(mesh: TetMesh, offset: tuple[float, float, float], scale: float = 1.0) -> TetMesh:
    return mesh.with_vertices(scale * mesh.vertices + offset)


def without(mesh: TetMesh, low: float, high: float) -> TetMesh:
    """The mesh without the tets whose middles are in a cube: a void."""
    middles = mesh.vertices[mesh.tets].mean(axis=1)
    kept = mesh.tets[~((middles > low) & (middles < high)).all(axis=1)]
    used = np.unique(kept)
    return TetMesh(mesh.vertices[used], np.searchsorted(used, kept))


def assert_refuted(found: MeshCertificate, note: str) -> None:
    assert found.claim is Claim.REFUTED
    assert note in found.note


def test_a_block_and_any_affine_image_that_keeps_orientation_are_certified() -> None:
    mesh = block((3, 2, 2))
    found = certify_mesh(mesh)
    assert (found.claim, found.tets, found.boundary_faces, found.sheets) == (Claim.CERTIFIED, 72, 64, 1)
    shear = np.array([[1.0, 0.7, 0.1], [0.0, 0.3, 2.0], [0.4, 0.0, 1.5]])
    assert certify_mesh(mesh.with_vertices(mesh.vertices @ shear.T + 1e3)).claim is Claim.CERTIFIED
    assert_refuted(certify_mesh(mesh.with_vertices(mesh.vertices * (1, 1, -1))), "72 tets are inverted")


@pytest.mark.parametrize("ulps", [1, 3])
def test_an_inversion_by_an_ulp_is_found_though_the_floating_point_volume_may_miss_it(ulps: int) -> None:
    """An inner vertex is put into the plane of a face across it, and one ulp beyond: at odd places, not on a grid."""
    mesh = block((3, 3, 3))
    rng = np.random.default_rng(ulps)
    mesh = mesh.with_vertices(100.0 + 10.0 * mesh.vertices + rng.uniform(-0.5, 0.5, mesh.vertices.shape))
    inner = 21
    tet = mesh.tets[(mesh.tets == inner).any(axis=1)][5]
    others = mesh.vertices[tet[tet != inner]]
    normal = np.cross(others[1] - others[0], others[2] - others[0])
    way = normal * np.sign(normal @ (others[0] - mesh.vertices[inner])) / np.linalg.norm(normal)
    vertices = np.array(mesh.vertices)
    flat = mesh.vertices[inner] + way * abs(way @ (others[0] - mesh.vertices[inner]))
    for _ in range(40):  # walk to the last place on the right side, one ulp at a time
        vertices[inner] = flat
        if orientations(vertices, tet[None])[0] > 0:
            break
        flat = np.nextafter(flat, flat - way)
    assert orientations(vertices, tet[None])[0] > 0
    while orientations(vertices, tet[None])[0] > 0:
        before = vertices[inner].copy()
        vertices[inner] = np.nextafter(before, before + ulps * way)
    number = int(np.flatnonzero((mesh.tets == tet).all(axis=1))[0])
    assert np.abs(vertices[inner] - before).max() <= 3e-14
    assert number in certify_mesh(mesh.with_vertices(vertices)).failing
    vertices[inner] = before
    assert number not in certify_mesh(mesh.with_vertices(vertices)).failing


def test_where_the_floating_point_volume_lies_the_certificate_does_not() -> None:
    """Flat fans of tets whose apexes are an ulp above or below: some volumes have the wrong sign in floating point."""
    rng = np.random.default_rng(5)
    lied = 0
    for _ in range(120):
        corners = rng.uniform(0, 300.0, (4, 3))
        weights = rng.dirichlet(np.ones(3))
        corners[3] = weights @ corners[:3]
        mesh = TetMesh(corners, np.array([[0, 1, 2, 3]]))
        exact = int(orientations(corners, mesh.tets)[0])
        floating = float(signed_volumes(corners, mesh.tets)[0])
        lied += np.sign(floating) != exact
        assert (certify_mesh(mesh).claim is Claim.CERTIFIED) == (exact > 0)
    assert lied > 5


def test_a_bar_bent_into_a_ring_is_certified_until_its_ends_meet() -> None:
    for degrees, claim in ((90, Claim.CERTIFIED), (340, Claim.CERTIFIED), (370, Claim.REFUTED)):
        found = certify_mesh(bent_bar(degrees))
        assert found.inverted == 0
        assert found.claim is claim
    assert found.crossings > 0
    assert "boundary triangles cross or touch" in found.note
    assert np.linalg.norm(found.crossing_places[:, :2], axis=1).max() < 8.0


def test_a_vertex_of_the_boundary_pushed_through_another_part_crosses() -> None:
    mesh = together(block((2, 2, 2)), moved(block((2, 2, 2)), (2.5, 0.2, 0.3)))
    assert certify_mesh(mesh).claim is Claim.CERTIFIED
    vertices = np.array(mesh.vertices)
    spike = 27 + int(np.argmin(np.linalg.norm(block((2, 2, 2)).vertices - (0, 1, 1), axis=1)))
    vertices[spike, 0] = 1.9
    found = certify_mesh(mesh.with_vertices(vertices))
    assert found.inverted == 0
    assert_refuted(found, "pairs of boundary triangles cross or touch")
    assert (mesh.tets[found.crossing_tets] == spike).any(axis=(1, 2)).all()


def test_contact_is_no_proof() -> None:
    shifted = moved(block((2, 2, 2)), (2.0, 0.25, 0.25))
    assert_refuted(certify_mesh(together(block((2, 2, 2)), shifted)), "cross or touch")
    corner = certify_mesh(together(block((1, 1, 1)), moved(block((1, 1, 1)), (1.0, 1.0, 1.0))))
    assert corner.claim is Claim.UNDECIDED
    assert "1 vertices of the boundary stand where another one stands" in corner.note


def test_a_body_wholly_inside_another_crosses_nothing_and_is_refuted() -> None:
    inside = moved(block((2, 2, 2)), (1.3, 1.3, 1.3), 0.1)
    found = certify_mesh(together(block((3, 3, 3)), inside))
    assert (found.inverted, found.crossings) == (0, 0)
    assert_refuted(found, "1 sheets of the boundary lie inside tets")


def test_a_void_is_no_cover_and_a_body_in_the_void_neither() -> None:
    hollow = without(block((5, 5, 5)), 1.0, 4.0)
    assert certify_mesh(hollow).sheets == 2
    assert certify_mesh(hollow).claim is Claim.CERTIFIED
    guest = certify_mesh(together(hollow, moved(block((1, 1, 1)), (1.7, 1.8, 1.9))))
    assert (guest.claim, guest.sheets) == (Claim.CERTIFIED, 3)


def test_tets_laid_over_their_neighbours_are_no_mesh() -> None:
    mesh = block((2, 2, 2))
    doubled = TetMesh(mesh.vertices, np.vstack([mesh.tets, mesh.tets[:1]]))
    found = certify_mesh(doubled)
    assert found.claim is not Claim.CERTIFIED
    assert "not conforming" in found.note


def test_a_corner_that_hangs_in_a_neighbours_face_is_contact() -> None:
    """One cell of two refined: the old face and the finer ones lie on one another, which counts as crossing."""
    coarse, fine = block((1, 1, 1)), moved(block((2, 2, 2)), (1.0, 0.0, 0.0), 0.5)
    mesh = together(coarse, fine)
    assert certify_mesh(mesh).claim is not Claim.CERTIFIED


def test_no_tets_are_no_proof_and_odd_positions_are_refused() -> None:
    none = certify_mesh(TetMesh(np.zeros((4, 3)), np.zeros((0, 4), np.int64)))
    assert (none.claim, none.note) == (Claim.UNDECIDED, "the mesh has no tet")
    flat = block((1, 1, 1))
    assert_refuted(certify_mesh(flat.with_vertices(flat.vertices * (1, 1, 0))), "6 tets are exactly flat")
    with pytest.raises(MeshError, match="not finite"):
        certify_mesh(flat.with_vertices(flat.vertices * np.nan))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from([0.2, 0.45, 0.8]))
def test_no_certified_mesh_has_a_point_in_two_tets(seed: int, size: float) -> None:
    """Random vertices of two blocks beside each other; points of space are counted in how many tets they lie."""
    rng = np.random.default_rng(seed)
    mesh = together(block((2, 2, 1)), moved(block((2, 1, 2)), (2.2, 0.1, 0.2)))
    vertices = mesh.vertices + rng.uniform(-size, size, mesh.vertices.shape) * rng.integers(
        0, 2, (len(mesh.vertices), 1)
    )
    found = certify_mesh(mesh.with_vertices(vertices))
    points = rng.uniform(vertices.min(axis=0), vertices.max(axis=0), (600, 3))
    corners = vertices[mesh.tets]
    edges = np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 2)
    solid = np.abs(np.linalg.det(edges)) > 1e-9
    local = np.linalg.solve(edges[solid][None], (points[:, None] - corners[solid][None, :, 0])[..., None])[..., 0]
    inside = ((local > 1e-7).all(axis=2) & (local.sum(axis=2) < 1.0 - 1e-7)).sum(axis=1)
    if inside.max() > 1:
        assert found.claim is not Claim.CERTIFIED
    if found.claim is Claim.CERTIFIED:
        np.testing.assert_array_less(0.0, signed_volumes(vertices, mesh.tets))
