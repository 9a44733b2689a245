"""Farthest-point sampling against its definition written out, and the landmarks made of it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError, LandmarkError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.spread import bone_landmarks, spread_over

CUBE = np.array([[x, y, z] for x in (0.0, 10.0) for y in (0.0, 10.0) for z in (0.0, 10.0)])
CLOUDS = arrays(np.float64, st.tuples(st.integers(8, 30), st.just(3)), elements=st.integers(-50, 50), unique=True)


def slow_spread(vertices: np.ndarray, count: int) -> list[int]:
    """Every distance, every time."""
    centre = vertices.mean(axis=0)
    chosen = [max(range(len(vertices)), key=lambda k: np.linalg.norm(vertices[k] - centre))]
    while len(chosen) < count:
        gaps = [min(np.linalg.norm(v - vertices[c]) for c in chosen) for v in vertices]
        chosen.append(int(np.argmax(gaps)))
    return chosen


@given(vertices=CLOUDS, count=st.integers(1, 8))
def test_it_is_farthest_point_sampling(vertices: np.ndarray, count: int) -> None:
    found = spread_over(vertices, count)
    assert found.tolist() == slow_spread(vertices, count)
    assert not found.flags.writeable
    np.testing.assert_array_equal(found, spread_over(vertices, 8)[:count])


def test_the_second_is_across_the_cube() -> None:
    first, second = spread_over(CUBE, 2)
    assert np.linalg.norm(CUBE[first] - CUBE[second]) == pytest.approx(np.sqrt(300.0), rel=1e-15)
    assert sorted(spread_over(CUBE, 8)) == list(range(8))


def test_too_many_landmarks_are_refused() -> None:
    doubled = np.vstack([CUBE, CUBE])
    with pytest.raises(LandmarkError, match=r"^9 landmarks do not fit on a surface with 8 distinct vertices; ask for"):
        spread_over(doubled, 9)
    with pytest.raises(LandmarkError, match=r"^found a count of 0 landmarks to spread; expected at least 1"):
        spread_over(CUBE, 0)
    with pytest.raises(LandmarkError, match=r"^no vertices to spread 2 landmarks over"):
        spread_over(np.empty((0, 3)), 2)


def test_bone_landmarks_are_named_and_owned() -> None:
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    surface = TriMesh(CUBE[[0, 1, 2, 4]], faces)
    bones = [
        Tissue(f"bone_{n}", TissueKind.BONE, surface.with_vertices(surface.vertices + 20.0 * k))
        for k, n in enumerate("ab")
    ]
    anatomy = Anatomy(tuple(bones), "test")
    handles = bone_landmarks(anatomy, ["bone_b", "bone_a"], per_bone=2)
    assert handles.names == ("bone_b_1", "bone_b_2", "bone_a_1", "bone_a_2")
    assert handles.owner == ("bone_b", "bone_b", "bone_a", "bone_a")
    np.testing.assert_array_equal(handles.source[:2], handles.source[2:] + 20.0)
    with pytest.raises(LandmarkError, match=r"^bone 'bone_a': 5 landmarks do not fit"):
        bone_landmarks(anatomy, ["bone_a"], per_bone=5)
    with pytest.raises(InputError, match="no tissue is named 'bone_c'"):
        bone_landmarks(anatomy, ["bone_c"], per_bone=2)


def test_no_bone_landmark_is_where_two_bones_meet() -> None:
    lower, upper = (trimesh.creation.box([10.0, 10.0, 40.0]) for _ in range(2))
    for _ in range(3):
        lower, upper = lower.subdivide(), upper.subdivide()
    places = [np.asarray(lower.vertices), np.add(upper.vertices, [0.0, 0.0, 40.1])]
    tissues = [
        Tissue(f"bone_{n}", TissueKind.BONE, TriMesh(v, mesh.faces))
        for n, v, mesh in zip("ab", places, (lower, upper), strict=True)
    ]
    anatomy = Anatomy(tuple(tissues), "test")
    handles = bone_landmarks(anatomy, ["bone_a", "bone_b"], per_bone=20)
    assert not np.isclose(np.abs(handles.source[:, 2] - 20.05), 0.05).any()
    # A bone between two others meets them everywhere, and has its landmarks all the same.
    few = Anatomy((tissues[0], Tissue("bone_c", TissueKind.BONE, TriMesh(places[0] * 1.001, lower.faces))), "test")
    assert len(bone_landmarks(few, ["bone_a"], per_bone=8).source) == 8


class _Tipped:
    """The upper bone is brought down, into the lower one."""

    def at(self, t: float) -> dict[str, RigidMotion]:
        return {"bone_b": RigidMotion(np.eye(3), np.array([0.0, 0.0, -30.0 * t]))}


def test_no_bone_landmark_is_within_another_bone_at_the_pose() -> None:
    box = trimesh.creation.box([10.0, 10.0, 40.0])
    for _ in range(3):
        box = box.subdivide()
    places = {"bone_a": np.asarray(box.vertices), "bone_b": np.add(0.8 * box.vertices, [0.0, 0.0, 60.0])}
    anatomy = Anatomy(tuple(Tissue(name, TissueKind.BONE, TriMesh(v, box.faces)) for name, v in places.items()), "test")
    at_rest = bone_landmarks(anatomy, ["bone_a", "bone_b"], per_bone=12)
    low = at_rest.source[np.array(at_rest.owner) == "bone_b"][:, 2] - 30.0
    assert (low < 20.0).any()  # they would be within the lower bone
    posed = bone_landmarks(anatomy, ["bone_a", "bone_b"], per_bone=12, motions=_Tipped())
    assert (posed.source[np.array(posed.owner) == "bone_b"][:, 2] - 30.0 > 20.0).all()
