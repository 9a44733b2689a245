"""Cages: as many vertices as asked for, closed, without crossings, and as large as what they follow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from musclefit.errors import InputError, MeshError
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.surfaces.cages import cage_of
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.topology import edges_of


def torus() -> TriMesh:
    made = trimesh.creation.torus(40.0, 12.0, major_sections=60, minor_sections=24)
    return TriMesh(made.vertices, made.faces)


def ball() -> TriMesh:
    made = trimesh.creation.icosphere(subdivisions=4, radius=50.0)
    return TriMesh(made.vertices * (1.0, 1.6, 0.5), made.faces)


def require_cage(cage: TriMesh, surface: TriMesh, *, vertices: int) -> None:
    """Closed, two faces at each edge, no crossing, the number asked for, the surface's volume and topology."""
    assert len(cage.vertices) == vertices == len(np.unique(cage.faces))
    edges = edges_of(cage.faces)
    assert (edges.faces_at == 2).all()
    assert not edges.excess.any()
    assert len(self_crossings(cage)) == 0
    assert enclosed_volume(cage) == pytest.approx(enclosed_volume(surface), rel=1e-3)
    for mesh in (cage, surface):
        assert len(mesh.vertices) - len(edges_of(mesh.faces).ends) + len(mesh.faces) in (0, 2)


@pytest.mark.parametrize("vertices", [40, 200])
def test_a_cage_of_a_ball_is_even(vertices: int) -> None:
    surface = ball()
    cage = cage_of(surface, vertices=vertices)
    require_cage(cage, surface, vertices=vertices)
    a, b = edges_of(cage.faces).ends.T
    lengths = np.linalg.norm(cage.vertices[a] - cage.vertices[b], axis=1)
    assert lengths.max() < 5.0 * lengths.min()
    assert nearest_places(surface.vertices, cage).distances.max() < np.median(lengths) / 3.0


def test_a_cage_of_a_ring_keeps_its_hole() -> None:
    surface = torus()
    cage = cage_of(surface, vertices=150)
    require_cage(cage, surface, vertices=150)
    assert len(cage.vertices) - len(edges_of(cage.faces).ends) + len(cage.faces) == 0


def test_what_cannot_have_a_cage_is_named() -> None:
    surface = ball()
    with pytest.raises(InputError, match="a cage of 5 vertices is asked for; give from 20 to 2562"):
        cage_of(surface, vertices=5)
    with pytest.raises(MeshError, match=r"the surface is not a closed surface .*: 3 boundary edges"):
        cage_of(TriMesh(surface.vertices, surface.faces[1:]), vertices=50)
    pulled = np.array(surface.vertices)
    pulled[0] *= -2.0
    with pytest.raises(MeshError, match=r"the surface crosses itself at \d+ pairs of triangles: \d+ and \d+ near \("):
        cage_of(surface.with_vertices(pulled), vertices=50)
    with pytest.raises(MeshError, match="inside out"):
        cage_of(TriMesh(surface.vertices, surface.faces[:, ::-1]), vertices=50)


@pytest.mark.anatomy
def test_a_cage_of_the_body_follows_its_skin(anatomy_data: Path) -> None:
    from musclefit.io.anatomy import read_surface

    skin = read_surface(anatomy_data / "body" / "skin.ply").mesh()
    cage = cage_of(skin, vertices=500)
    require_cage(cage, skin, vertices=500)
    assert nearest_places(skin.vertices, cage).distances.mean() < 4.0
