"""Factors per axis: exact where the map is a scaling, the same on every mesh of a surface, refused where none fit."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.errors import InputError
from musclefit.geometry.meshes import TriMesh
from musclefit.rig.linear_fits import axis_factors

BOX = trimesh.creation.box(extents=[40.0, 300.0, 60.0])
PLANE = np.array([1.0, 0.0, 1.0])


def surface(mesh: trimesh.Trimesh) -> TriMesh:
    return TriMesh(np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64))


def test_a_scaling_comes_back() -> None:
    bone = surface(BOX)
    found = axis_factors(bone, bone.vertices * (1.1, 0.9, 1.3) + (5.0, -7.0, 2.0), name="femur")
    np.testing.assert_allclose(found.factors, (1.1, 0.9, 1.3), rtol=1e-12)
    np.testing.assert_allclose(found.offset, (5.0, -7.0, 2.0), rtol=0, atol=1e-10)


def test_small_triangles_at_one_end_do_not_count_more() -> None:
    def bend(points: np.ndarray) -> np.ndarray:
        return points * (1.0, 1.1, 1.0) + 5e-4 * points[:, [1]] ** 2 * (1.0, 1.0, 0.0)

    even = BOX.subdivide().subdivide().subdivide()
    uneven = even
    for _ in range(3):
        uneven = uneven.subdivide(face_index=np.nonzero(uneven.triangles_center[:, 1] > 100.0)[0])
    found = [axis_factors(surface(m), bend(np.array(m.vertices)), name="femur").factors for m in (even, uneven)]
    assert len(uneven.faces) > 5 * len(even.faces)
    np.testing.assert_allclose(found[1], found[0], rtol=2e-3)
    by_vertices = np.polyfit(np.array(uneven.vertices)[:, 1], bend(np.array(uneven.vertices))[:, 1], 1)[0]
    assert abs(by_vertices - found[0][1]) > 5e-3


def test_a_bone_turned_by_the_map_is_refused_by_name() -> None:
    bone = surface(BOX)
    with pytest.raises(InputError, match=r"body 'femur': its best linear factors are .*; all must be above 0"):
        axis_factors(bone, bone.vertices[:, [1, 0, 2]] * (-1.0, 1.0, 1.0) * (1.0, -1.0, 1.0), name="femur")


def test_a_flat_bone_is_refused_with_its_axis() -> None:
    bone = surface(BOX)
    flat = TriMesh(bone.vertices * PLANE, bone.faces)
    with pytest.raises(InputError, match=r"body 'blade': its geometry has no extent along y"):
        axis_factors(flat, flat.vertices, name="blade")
    with pytest.raises(InputError, match=r"body 'line': its geometry has no area"):
        axis_factors(TriMesh(bone.vertices * (1.0, 0.0, 0.0), bone.faces), bone.vertices, name="line")
