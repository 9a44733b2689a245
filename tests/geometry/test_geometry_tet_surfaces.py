"""Surfaces of parts of a tet mesh: closed, of the part's volume, and apart where the part is pinched."""

from __future__ import annotations

import numpy as np
import pytest
from tet_blocks import block
from tet_surfaces import surface_of_tets

from musclefit.geometry.measures import enclosed_volume, signed_volumes
from musclefit.geometry.queries.solids import overlap_volume, solid_of
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.topology import edges_of, face_components

CELLS = (4, 4, 4)


def cells(*wanted: tuple[int, int, int]) -> np.ndarray:
    """Numbers of the tets in some cubes of the block."""
    mesh = block(CELLS)
    middles = np.floor(mesh.vertices[mesh.tets].mean(axis=1)).astype(int)
    return np.flatnonzero((middles[:, None] == np.array(wanted)).all(axis=2).any(axis=1))


@pytest.mark.parametrize(
    ("wanted", "pieces"),
    [
        ([(0, 0, 0)], 1),
        ([(0, 0, 0), (1, 0, 0), (1, 1, 0)], 1),
        ([(0, 0, 0), (1, 1, 0)], 2),  # an edge in common
        ([(0, 0, 0), (1, 1, 1)], 2),  # a corner in common
        ([(0, 0, 0), (2, 2, 2)], 2),
    ],
)
def test_surfaces_are_closed_two_sided_and_of_the_volume_of_their_tets(
    wanted: list[tuple[int, int, int]], pieces: int
) -> None:
    mesh, part = block(CELLS), cells(*wanted)
    surface = surface_of_tets(mesh, part)
    edges = edges_of(surface.faces)
    assert (edges.faces_at == 2).all()
    assert (edges.excess == 0).all()
    assert face_components(surface.faces).max() + 1 == pieces
    np.testing.assert_allclose(enclosed_volume(surface), len(wanted), rtol=1e-12)
    assert len(self_crossings(surface)) == 0


def test_parts_that_share_a_ragged_interface_have_no_volume_in_common_as_solids() -> None:
    """Tets dealt out at random, moved by an affine map: what is proved of the mesh is seen in the booleans."""
    mesh = block(CELLS)
    mesh = mesh.with_vertices(mesh.vertices @ np.array([[1.1, 0.2, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.4, 1.2]]) + 0.1)
    owner = np.random.default_rng(3).integers(0, 3, len(mesh.tets))
    solids = [solid_of(surface_of_tets(mesh, np.flatnonzero(owner == k))) for k in range(3)]
    volumes = [signed_volumes(mesh.vertices, mesh.tets[owner == k]).sum() for k in range(3)]
    np.testing.assert_allclose([solid.volume for solid in solids], volumes, rtol=1e-9)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert abs(overlap_volume(solids[a], solids[b])) < 1e-9
