"""Rigs whose handles go through keyframes, on screws or along a skeleton, from their files to the deformed handles."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from musclefit.errors import LandmarkError, MeshError, RigError
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform
from musclefit.pipeline.sequence import posed_job
from musclefit.progress import Silent
from musclefit.rig.motion import Pose

ANATOMY = 'title = "Bar"\n[anatomy]\nfolder = "tissues"\n'
IMPLICIT = '[deformer]\nstep = "cayley"\nkernel = "isochoric-r3"\n'
NAMES = ("a", "b", "c", "d", "e")
AXIS = np.array([[0.0, 0.0, 10.0 * k] for k in range(5)])
ACROSS = np.vstack([AXIS[:4], [[8.0, 0.0, 20.0]]])


def write_landmarks(path: Path, places: np.ndarray, *, bone: str = "") -> None:
    rows = [f"{n},{bone}," + ",".join(map(repr, map(float, p))) for n, p in zip(NAMES, places, strict=True)]
    path.write_text("\n".join(["name,bone,x_mm,y_mm,z_mm", *rows]) + "\n")


def write_bar(path: Path, *, width: float = 6.0) -> None:
    """A closed bar along z in ASCII PLY."""
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    vertices = (corners - [0.5, 0.5, 0.0]) * [width, width, 40.0]
    head = "ply\nformat ascii 1.0\nelement vertex 8\nproperty double x\nproperty double y\nproperty double z\n"
    head += "element face 12\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(repr, map(float, v))) for v in vertices] + ["3 " + " ".join(map(str, f)) for f in faces]
    path.write_text(head + "\n".join(rows) + "\n")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "tissues").mkdir()
    write_bar(tmp_path / "tissues" / "bone_bar.ply")
    return tmp_path


def rig(folder: Path, drive: str, deformer: str = IMPLICIT) -> Path:
    (folder / "rig.toml").write_text(f"{ANATOMY}[drive]\n{drive}\n{deformer}")
    return folder / "rig.toml"


def turned(degrees: float, places: np.ndarray) -> np.ndarray:
    motion = RigidMotion.about_axis(centre=np.zeros(3), axis=np.array([0.0, 1.0, 0.0]), angle_deg=degrees)
    return motion(places)


def arc(degrees: float) -> np.ndarray:
    along = np.deg2rad(degrees) / 40.0 * AXIS[:, 2]
    return np.stack([1.0 - np.cos(along), 0.0 * along, np.sin(along)], axis=1) * 40.0 / np.deg2rad(degrees)


def test_landmarks_go_through_the_places_of_a_keyframe(folder: Path) -> None:
    half = ACROSS + np.array([0.0, 5.0, 0.0])
    for name, places in (("rest", ACROSS), ("half", half), ("end", ACROSS + np.array([9.0, 0.0, 0.0]))):
        write_landmarks(folder / f"{name}.csv", places)
    drive = 'kind = "landmarks"\nsource = "rest.csv"\ntarget = "end.csv"\nkeyframes = [{ at = 0.5, file = "half.csv" }]'
    job = read_rig(rig(folder, drive))
    assert job.stops == (0.5,)
    np.testing.assert_allclose(job.path.position(0.5), half, rtol=0, atol=1e-12)
    deformation = deform(job, job.anatomy.vertices(), progress=Silent()).deformation
    ends = [record.end for record in deformation.records]
    assert 0.5 in ends
    first = deformation.steps[: ends.index(0.5) + 1]
    moved = job.handles.source
    for step in first:
        moved = step(moved)
    np.testing.assert_allclose(moved, half, rtol=0, atol=1e-9)
    np.testing.assert_allclose(deformation(job.handles.source), job.path.position(1.0), rtol=0, atol=1e-9)


def test_landmarks_of_a_bone_go_on_its_screw(folder: Path) -> None:
    write_landmarks(folder / "rest.csv", ACROSS, bone="bone_bar")
    write_landmarks(folder / "end.csv", turned(100.0, ACROSS), bone="bone_bar")
    drive = 'kind = "landmarks"\nsource = "rest.csv"\ntarget = "end.csv"'
    job = read_rig(rig(folder, drive, IMPLICIT + 'path = "screws"\n'))
    np.testing.assert_allclose(job.path.position(0.3), turned(30.0, ACROSS), rtol=0, atol=1e-10)


def test_five_landmarks_on_an_axis_bend_a_bar(folder: Path) -> None:
    """The bar's handles arrive, and every volume that the isochoric field carries is kept."""
    write_landmarks(folder / "rest.csv", AXIS)
    write_landmarks(folder / "end.csv", arc(90.0))
    drive = (
        'kind = "skeleton"\nsource = "rest.csv"\ntarget = "end.csv"\nring_mm = 3\nnormal = [1, 0, 0]\n'
        "twist_deg = [0, 30, 60, 90, 120]"
    )
    job = read_rig(rig(folder, drive, IMPLICIT + "min_steps = 3\n"))
    assert len(job.handles) == 25
    np.testing.assert_allclose(job.path.position(1.0)[:5], arc(90.0), rtol=0, atol=1e-12)
    deformation = deform(job, job.anatomy.vertices(), progress=Silent()).deformation
    np.testing.assert_allclose(deformation(job.handles.source), job.path.position(1.0), rtol=0, atol=1e-9)
    inside = np.random.default_rng(0).uniform([-2.0, -2.0, 2.0], [2.0, 2.0, 38.0], (200, 3))
    determinants = np.linalg.det(deformation.jacobian(inside))
    np.testing.assert_allclose(determinants, 1.0, rtol=0, atol=0.02)


def test_joints_go_through_keyframed_poses(folder: Path) -> None:
    joints = {"units": "mm", "hinge": {"centre_mm": [0, 0, 0], "axis": [0, 1, 0], "fixed": [], "moving": ["bone_bar"]}}
    (folder / "joints.json").write_text(json.dumps(joints))
    drive = (
        'kind = "joints"\njoints = "joints.json"\npose = { hinge_deg = 40 }\nlandmarks_per_bone = 5\n'
        "keyframes = [{ at = 0.25, hinge_deg = 80 }]"
    )
    job = read_rig(rig(folder, drive, IMPLICIT + 'path = "joints"\n'))
    np.testing.assert_allclose(job.path.position(0.25), turned(80.0, job.handles.source), rtol=0, atol=1e-12)
    np.testing.assert_allclose(job.path.position(1.0), turned(40.0, job.handles.source), rtol=0, atol=1e-12)
    posed = posed_job(job, Pose(0, 0.0, (("hinge", 60.0),)))
    assert posed.stops == ()
    np.testing.assert_allclose(posed.path.position(0.25), turned(15.0, job.handles.source), rtol=0, atol=1e-12)
    with pytest.raises(RigError, match=r"drive.keyframes: have no effect on path \"screws\"; write .*\"joints\""):
        read_rig(rig(folder, drive, IMPLICIT + 'path = "screws"\n'))


PAIRS = 'kind = "landmarks"\nsource = "rest.csv"\ntarget = "end.csv"\n'


@pytest.mark.parametrize(
    ("drive", "deformer", "message"),
    [
        (PAIRS + 'keyframes = [{ at = 1.5, file = "rest.csv" }]', "", r"found the moments \[1.5\].*below 1"),
        (PAIRS + "keyframes = [{ at = 0.5 }]", "", r"drive.keyframes\[0\].file: is missing"),
        (
            PAIRS + 'keyframes = [{ at = 0.5, file = "rest.csv", twist_deg = [1] }]',
            "",
            r"keyframes\[0\].twist_deg: unkno",
        ),
        (PAIRS + 'keyframes = [{ at = 0.5, file = "few.csv" }]', "", r"drive.keyframes: .*few.csv: .*missing.*: e"),
        (PAIRS + "keyframes = 0.5", "", r"drive.keyframes: found the number 0.5; expected a list of tables"),
        (PAIRS, 'path = "screws"', r"no landmark names a bone"),
        (PAIRS.replace("landmarks", "skeleton"), "", r"drive.ring_mm: is missing"),
        (
            PAIRS.replace("landmarks", "skeleton") + "ring_mm = 1\nnormal = [0, 0, 1]",
            "",
            r"normal .* is along the curve",
        ),
    ],
)
def test_slips_are_named(folder: Path, drive: str, deformer: str, message: str) -> None:
    write_landmarks(folder / "rest.csv", AXIS)
    write_landmarks(folder / "end.csv", arc(90.0))
    (folder / "few.csv").write_text("\n".join((folder / "rest.csv").read_text().splitlines()[:5]) + "\n")
    with pytest.raises((RigError, LandmarkError, MeshError), match=message):
        read_rig(rig(folder, drive, f"[deformer]\n{deformer}\n"))
