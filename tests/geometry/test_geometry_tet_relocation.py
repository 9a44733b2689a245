"""Vertices moved until no tet is inverted: the energy's slope is that of its values, springs and planes are kept."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import check_grad
from tet_blocks import block

from musclefit.geometry.arrays import Float
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.tets.orientation import orientations
from musclefit.geometry.tets.relocation import Planes, Springs, _energy, inverse_shapes, relocated


@pytest.mark.parametrize("softness", [1.0, 0.1])
def test_the_slope_of_the_energy_is_that_of_its_values(softness: float) -> None:
    mesh = block((2, 1, 1))
    rng = np.random.default_rng(3)
    shapes, weights = inverse_shapes(mesh.vertices, mesh.tets), rng.uniform(0.5, 2.0, len(mesh.tets))
    places = mesh.vertices + rng.uniform(-0.6, 0.6, mesh.vertices.shape)
    assert (signed_volumes(places, mesh.tets) < 0).any()
    slope = np.zeros_like(places)

    def value(flat: Float) -> float:
        return float(_energy(flat.reshape(-1, 3), mesh.tets, shapes, weights, softness, slope))

    def gradient(flat: Float) -> Float:
        value(flat)
        return slope.ravel().copy()

    size = np.linalg.norm(gradient(places.ravel()))
    assert check_grad(value, gradient, places.ravel()) < 1e-5 * size


def test_an_undeformed_tet_has_the_least_energy() -> None:
    mesh = block((1, 1, 1))
    slope = np.zeros_like(mesh.vertices)
    shapes = inverse_shapes(mesh.vertices, mesh.tets)
    least = _energy(mesh.vertices, mesh.tets, shapes, np.ones(6), 1e-6, slope)
    np.testing.assert_allclose(least, 6 * (3 + 2), rtol=1e-9, atol=0)
    np.testing.assert_allclose(slope, 0.0, rtol=0, atol=1e-8)


def test_a_vertex_pushed_through_its_neighbours_comes_back() -> None:
    mesh = block((2, 2, 2))
    places = np.array(mesh.vertices)
    places[13] += [3.0, -2.0, 1.5]  # the only one inside
    assert (orientations(places, mesh.tets) < 0).any()
    around = mesh.tets[(mesh.tets == 13).any(axis=1)]
    for softness in (1.0, 0.3, 0.1, 0.03):
        places = relocated(
            places,
            around,
            free=np.array([13]),
            shapes=inverse_shapes(mesh.vertices, around),
            weights=np.ones(len(around)),
            springs=Springs(places[[13]], np.zeros(1)),
            planes=Planes.none(),
            softness=softness,
            iterations=50,
        )
    assert (orientations(places, mesh.tets) > 0).all()
    others = np.arange(27) != 13
    np.testing.assert_array_equal(places[others], mesh.vertices[others])


def test_springs_pull_and_planes_hold_off() -> None:
    """One spring of strength 1 pulls to x = 3, a plane of strength 10 holds at x = 2: they rest where both balance."""
    mesh = block((1, 1, 1))
    nothing = np.zeros((0, 4), np.int64)
    held = Planes(
        np.array([[7, 7, 7]]), np.full((1, 3), 1 / 3), np.array([[2.0, 0, 0]]), np.array([[-1.0, 0, 0]]), [0.0]
    )
    found = relocated(
        mesh.vertices,
        np.concatenate([nothing, mesh.tets]),
        free=np.array([7]),
        shapes=inverse_shapes(mesh.vertices, mesh.tets),
        weights=np.zeros(6),
        springs=Springs(np.array([[3.0, 1, 1]]), np.ones(1)),
        planes=held,
        softness=1.0,
        iterations=50,
    )
    np.testing.assert_allclose(found[7], [(3.0 + 10 * 2.0) / 11, 1, 1], rtol=0, atol=1e-6)
