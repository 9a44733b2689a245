"""Transforms as values: what counts as rigid, motions between times, other references, frames, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.transforms import (
    BoneTransforms,
    Given,
    motion_of_matrix,
    motion_of_quaternion,
    still_findings,
)
from musclefit.vocabulary import PathKind

AXIS, CENTRE = np.array([1.0, 2.0, 2.0]) / 3.0, np.array([200.0, -50.0, 30.0])
POINTS = np.random.default_rng(0).uniform(-100.0, 100.0, (20, 3))


def turned(degrees: float, slide_mm: float = 0.0) -> RigidMotion:
    about = RigidMotion.about_axis(centre=CENTRE, axis=AXIS, angle_deg=degrees)
    return RigidMotion(about.rotation, about.translation + slide_mm * AXIS)


def matrix_of(motion: RigidMotion) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = motion.rotation, motion.translation
    return matrix


def given_at(bone: str, *poses: tuple[float | None, RigidMotion]) -> list[Given]:
    return [Given(bone, time, f"line {k}", motion, 0.0) for k, (time, motion) in enumerate(poses)]


def same(a: RigidMotion, b: RigidMotion, *, within_mm: float = 1e-11) -> None:
    np.testing.assert_allclose(a(POINTS), b(POINTS), rtol=0, atol=within_mm)


# --- matrices and quaternions


def test_a_rigid_matrix_is_taken_as_it_is() -> None:
    motion, deviation = motion_of_matrix(matrix_of(turned(40.0, 7.0)), place="here")
    same(motion, turned(40.0, 7.0))
    assert deviation < 1e-14


@given(angles=st.tuples(*[st.floats(-180, 180)] * 3), noise=st.floats(1e-8, 2e-4), seed=st.integers(0, 99))
def test_a_small_deviation_gives_the_nearest_rotation(
    angles: tuple[float, float, float], noise: float, seed: int
) -> None:
    """Nearest in the Frobenius norm: no other rotation near it is nearer; the deviation bounds what lengths are off."""
    rng = np.random.default_rng(seed)
    matrix = matrix_of(RigidMotion(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), CENTRE))
    matrix[:3, :3] += noise * rng.uniform(-1.0, 1.0, (3, 3))
    motion, deviation = motion_of_matrix(matrix, place="here")
    np.testing.assert_allclose(motion.rotation @ motion.rotation.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(motion.rotation) > 0
    off = np.linalg.norm(matrix[:3, :3] - motion.rotation)
    for _ in range(20):
        other = Rotation.from_rotvec(rng.normal(scale=noise, size=3)).as_matrix() @ motion.rotation
        assert np.linalg.norm(matrix[:3, :3] - other) >= off - 1e-15
    lengths = np.linalg.norm(POINTS @ matrix[:3, :3].T, axis=1) / np.linalg.norm(POINTS, axis=1)
    assert np.abs(lengths - 1.0).max() <= deviation + 1e-12


BAD_MATRICES = {
    "mirror": (np.diag([1.0, 1.0, -1.0, 1.0]), r"determinant -1: a mirror; expected a rotation.*right-handed frame"),
    "scaled": (np.diag([1.02, 1.02, 1.02, 1.0]), r"deviation from a rotation 0.02 \(it scales by 1.02\).*most 0.001"),
    "zero": (np.diag([0.0, 0.0, 0.0, 1.0]), r"deviation from a rotation 1 "),
    "shear": (np.eye(4) + 0.04 * np.eye(4, k=1) * (np.arange(4) == 0)[:, None], r"rotation 0.0202 \(it shears or"),
    "huge": (np.diag([1e300, 1.0, 1.0, 1.0]), r"the rotation holds 1e\+300; expected entries from -1 to 1"),
    "nan": (np.diag([np.nan, 1.0, 1.0, 1.0]), r"holds nan; expected finite"),
    "last row": (np.diag([1.0, 1.0, 1.0, 0.5]), r"the last row is \(0, 0, 0, 0.5\); expected \(0, 0, 0, 1\)"),
    "column by column": (matrix_of(turned(10.0)).T, r"the last row is .*it is written column by column: transpose it"),
    "far": (matrix_of(RigidMotion(np.eye(3), np.array([0.0, 1e200, 0.0]))), r"translation holds 1e\+200 mm"),
}


@pytest.mark.parametrize("name", BAD_MATRICES)
def test_what_is_no_rigid_motion_is_refused_with_its_deviation(name: str) -> None:
    matrix, words = BAD_MATRICES[name]
    with pytest.raises(InputError, match=rf"^f.csv: line 3: .*{words}"):
        motion_of_matrix(matrix, place="f.csv: line 3")


def test_a_quaternion_has_w_first_and_length_one() -> None:
    half = np.deg2rad(20.0)
    wxyz = np.array([np.cos(half), *(np.sin(half) * AXIS)])
    motion, deviation = motion_of_quaternion(1.0005 * wxyz, turned(40.0).translation, place="here")
    same(motion, turned(40.0))
    assert deviation == pytest.approx(5e-4)
    for bad, words in (
        (1.2 * wxyz, r"the quaternion's length is 1.2; expected 1"),
        (0.0 * wxyz, r"length is 0;"),
        (1e300 * wxyz, r"length is (inf|1e\+300)"),
        (np.nan * wxyz, r"holds nan"),
    ):
        with pytest.raises(InputError, match=words):
            motion_of_quaternion(bad, np.zeros(3), place="here")
    with pytest.raises(InputError, match=r"translation holds 1e\+20 mm; expected at most 1e\+07"):
        motion_of_quaternion(wxyz, np.array([1e20, 0.0, 0.0]), place="here")


# --- over time


def test_between_two_times_a_bone_is_on_the_screw_between_them() -> None:
    """The same wherever the coordinates' origin is: turn and slide grow evenly about the true axis."""
    given = given_at("radius", (1.0, turned(10.0, 2.0)), (3.0, turned(70.0, 8.0)))
    moving = BoneTransforms.of(given, source="f.csv")
    same(moving.at(2.0)["radius"], turned(40.0, 5.0))
    same(moving.at(1.5)["radius"], turned(25.0, 3.5))
    assert moving.at(3.0)["radius"] is given[1].motion
    with pytest.raises(InputError, match=r"f.csv: asked for 3.5 s; its bones are known from 1 to 3 s"):
        moving.at(3.5)


def test_rows_may_stand_in_any_order_and_bones_may_lack_times() -> None:
    given = [
        *given_at("ulna", (2.0, turned(20.0)), (0.0, turned(0.0)), (1.0, turned(10.0))),
        *given_at("radius", (2.5, turned(50.0)), (0.5, turned(10.0))),
    ]
    moving = BoneTransforms.of(given, source="in/f.csv")
    assert (moving.first_s, moving.last_s) == (0.5, 2.0)
    np.testing.assert_array_equal(moving.times_s, [0.5, 1.0, 2.0])
    same(moving.at(1.5)["ulna"], turned(15.0))
    same(moving.at(1.5)["radius"], turned(30.0))
    (finding,) = moving.findings
    assert (finding.subject, finding.code) == ("f.csv", "missing-times")
    assert "of 5 times some bones lack some: ulna 2, radius 3" in finding.message


def test_another_reference_is_where_the_bones_rest() -> None:
    given = given_at("radius", (0.0, turned(10.0)), (1.0, turned(30.0)), (2.0, turned(60.0)))
    moving = BoneTransforms.of(given, source="f.csv").relative_to(1.0)
    rest = moving.at(1.0)["radius"]
    np.testing.assert_array_equal(rest.rotation, np.eye(3))
    np.testing.assert_array_equal(rest.translation, np.zeros(3))
    same(moving.at(2.0)["radius"], turned(30.0))
    same(moving.at(0.0)["radius"], turned(-20.0))
    between = BoneTransforms.of(given, source="f.csv").relative_to(1.5)
    same(between.at(2.0)["radius"], turned(15.0))
    same(between.at(1.5)["radius"], RigidMotion.identity(), within_mm=0.0)


def test_a_run_goes_to_the_last_time_or_to_the_one_named() -> None:
    moving = BoneTransforms.of(given_at("b", (0.0, turned(0.0)), (1.0, turned(30.0))), source="f.csv")
    same(moving.motions(None, kind=PathKind.SCREWS).at(1.0)["b"], turned(30.0))
    same(moving.motions(0.5, kind=PathKind.SCREWS).at(1.0)["b"], turned(15.0))
    same(moving.motions(0.5, kind=PathKind.SCREWS).at(0.5)["b"], turned(7.5))


def test_one_pose_has_no_times_to_ask_for() -> None:
    still = BoneTransforms.of(given_at("b", (None, turned(30.0))), source="f.csv")
    same(still.motions(None, kind=PathKind.SCREWS).at(1.0)["b"], turned(30.0))
    for ask in (
        lambda: still.motions(0.0, kind=PathKind.SCREWS),
        lambda: still.relative_to(0.0),
        lambda: still.frames(0),
    ):
        with pytest.raises(InputError, match=r"^f.csv: states no times, so there is one pose alone"):
            ask()


def test_frames_are_at_the_files_times_or_even() -> None:
    given = given_at("b", (0.0, turned(0.0)), (0.1, turned(3.0)), (1.0, turned(30.0)))
    moving = BoneTransforms.of(given, source="f.csv")
    assert [pose.time_s for pose in moving.frames(0)] == [0.0, 0.1, 1.0]
    assert [(pose.number, pose.time_s, pose.said) for pose in moving.frames(3)] == [
        (0, 0.0, "0 s"),
        (1, 0.5, "0.5 s"),
        (2, 1.0, "1 s"),
    ]
    assert "1 bones at 3 times" in moving.resampling_in_words(0)
    assert "one frame at each from 0 s to 1 s" in moving.resampling_in_words(0)
    assert "5 frames evenly spaced in time" in moving.resampling_in_words(5)
    for count in (1, -3):
        with pytest.raises(InputError, match=r"a sequence needs at least 2"):
            moving.frames(count)
    once = BoneTransforms.of(given_at("b", (0.0, turned(0.0))), source="f.csv")
    with pytest.raises(InputError, match=r"found 1 times that all bones have; a sequence needs at least 2"):
        once.frames(0)


def test_other_motions_have_another_digest() -> None:
    given = given_at("b", (0.0, turned(0.0)), (1.0, turned(30.0)))
    digest = BoneTransforms.of(given, source="f.csv").digest()
    assert BoneTransforms.of(list(reversed(given)), source="g.csv").digest() == digest
    others = (
        given_at("c", (0.0, turned(0.0)), (1.0, turned(30.0))),
        given_at("b", (0.0, turned(0.0)), (1.1, turned(30.0))),
        given_at("b", (0.0, turned(0.0)), (1.0, turned(31.0))),
    )
    assert all(BoneTransforms.of(other, source="f.csv").digest() != digest for other in others)


# --- refusals


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([], r"holds no transform"),
        (
            given_at("b", (0.0, turned(0.0)), (0.0, turned(1.0))),
            r"bone 'b' at 0 s stands twice, at line 0 and line 1; remove one",
        ),
        (
            given_at("b", (None, turned(0.0)), (None, turned(1.0))),
            r"bone 'b' stands twice, at line 0 and line 1; give each its time_s, or remove one",
        ),
        (
            [*given_at("b", (0.0, turned(0.0))), *given_at("c", (None, turned(1.0)))],
            r"line 0: bone 'c' states no time, but bone 'b' at 0 s does",
        ),
        (
            [*given_at("b", (0.0, turned(0.0)), (1.0, turned(0.0))), *given_at("c", (2.0, turned(1.0)))],
            r"bone 'c' at 2 s begins after bone 'b' at 1 s ends; give times that all bones have",
        ),
    ],
)
def test_files_that_contradict_themselves_are_refused(given: list[Given], words: str) -> None:
    with pytest.raises(InputError, match=rf"^f.csv: {words}"):
        BoneTransforms.of(given, source="f.csv")


def test_deviations_are_told_with_the_worst() -> None:
    given = [Given("b", 0.5, "line 2", turned(1.0), 1e-16), Given("b", 0.6, "line 3", turned(1.0), 2e-4)]
    (finding,) = BoneTransforms.of(given, source="in/f.csv").findings
    assert finding.code == "projected-rotation"
    assert "1 of 2 transforms are not exactly rotations" in finding.message
    assert "bone 'b' at 0.6 s (line 3): off by 0.0002, 0.2 mm at 1 m" in finding.message


TETRAHEDRON = TriMesh(
    np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]]), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
)


def test_bones_must_be_bones_of_the_anatomy_and_stay_near() -> None:
    kinds = {"radius": TissueKind.BONE, "ulna": TissueKind.BONE, "biceps": TissueKind.MUSCLE}
    anatomy = Anatomy(tuple(Tissue(name, kind, TETRAHEDRON) for name, kind in kinds.items()), "none")

    def check(bone: str, motion: RigidMotion, time: float | None = None) -> None:
        BoneTransforms.of(given_at(bone, (time, motion)), source="f.csv").check_bones(anatomy)

    near, far = (RigidMotion(np.eye(3), np.array([x, 0.0, 0.0])) for x in (300.0, 400.0))
    check("radius", near)
    with pytest.raises(InputError, match=r"^f.csv: the anatomy has no bone 'radus'; did you mean 'radius'\?"):
        check("radus", near)
    with pytest.raises(InputError, match=r"^f.csv: 'biceps' is of kind 'muscle', and transforms move bones"):
        check("biceps", near)
    with pytest.raises(
        InputError, match=r"bone 'ulna' at 2 s is sent 400 mm away; .*diagonal of 17.32 mm: likely wrong"
    ):
        check("ulna", far, 2.0)
    (finding,) = still_findings(anatomy, ("radius",), subject="rig", said="have no transform", code="x")
    assert finding.message == "1 bones have no transform and follow the soft tissue: ulna"
    assert still_findings(anatomy, ("radius", "ulna"), subject="rig", said="", code="x") == ()


# --- screws measured


@given(degrees=st.floats(0.0, 179.0), slide=st.floats(-50.0, 50.0))
def test_a_motion_knows_its_turn_and_its_slide(degrees: float, slide: float) -> None:
    motion = turned(degrees, slide)
    assert motion.turn_deg == pytest.approx(degrees, abs=1e-6)
    if degrees > 0.1:
        assert motion.slide_mm == pytest.approx(abs(slide), abs=1e-6)
    assert RigidMotion(np.eye(3), np.array([3.0, 4.0, 0.0])).slide_mm == 5.0
