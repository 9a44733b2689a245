"""Bad input through the command line: exit code 2, a message that a user can act on, and nothing written anywhere."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh
from tiny_rigs import TISSUES, drive_by, drive_by_joints, landmark_rows, write_landmarks, write_tiny_rig

from musclefit.cli import main
from musclefit.geometry.meshes import TriMesh
from musclefit.io.run_folder import ply_bytes


@dataclass(frozen=True)
class Place:
    """A tiny rig on disk, and where its results would go."""

    rig: Path
    out: Path

    @property
    def anatomy(self) -> Path:
        return self.rig.parent / "anatomy"

    @property
    def bone(self) -> Path:
        return self.anatomy / "bone_distal.ply"

    @property
    def landmarks(self) -> Path:
        return self.rig.parent / "landmarks.csv"

    @property
    def joints(self) -> Path:
        return self.rig.parent / "joints.toml"

    def replace(self, old: str, new: str) -> None:
        """Change the rig's text."""
        change(self.rig, old, new)

    def filled_in(self, words: str) -> str:
        """The words with ``{bone}`` and the like replaced by paths."""
        names = ("rig", "anatomy", "bone", "landmarks", "joints")
        return words.format(**{name: getattr(self, name) for name in names})

    def run(self, *more: str) -> list[str]:
        return ["run", str(self.rig), "--out", str(self.out), *more]

    def check(self, *more: str) -> list[str]:
        return ["check", str(self.anatomy), "--out", str(self.out), *more]


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


@dataclass(frozen=True)
class Case:
    """What is broken, and the words that the message must hold (``{...}`` are filled in with the place's paths)."""

    name: str
    words: tuple[str, ...]
    arrange: Callable[[Place], Sequence[str]]


CASES: list[Case] = []


def case(*words: str) -> Callable[[Callable[[Place], Sequence[str]]], Callable[[Place], Sequence[str]]]:
    """Add a function that breaks something and gives the arguments; its name is the case's."""

    def add(arrange: Callable[[Place], Sequence[str]]) -> Callable[[Place], Sequence[str]]:
        CASES.append(Case(arrange.__name__, words, arrange))
        return arrange

    return add


# --- the rig file


@case("tiny.toml", "is not valid TOML", "line 3")
def broken_toml(at: Place) -> Sequence[str]:
    at.replace("[anatomy]", "[anatomy")
    at.rig.write_text(at.rig.read_text(encoding="utf-8").lstrip(), encoding="utf-8")
    return at.run()


@case("tiny.toml", "deformer.kernal", "unknown key", "did you mean 'kernel'?")
def unknown_key(at: Place) -> Sequence[str]:
    at.replace("kernel =", "kernal =")
    return at.run()


@case("tiny.toml", "anatomi", "did you mean 'anatomy'?")
def unknown_section(at: Place) -> Sequence[str]:
    at.replace("[anatomy]", "[anatomi]")
    return at.run()


@case("tiny.toml", "deformer.max_steps", "the text 'many'", "whole number")
def wrong_type(at: Place) -> Sequence[str]:
    at.replace("[deformer]", '[deformer]\nmax_steps = "many"')
    return at.run()


@case("tiny.toml", "deformer.max_steps", "found 0", "at least 1")
def value_out_of_range(at: Place) -> Sequence[str]:
    at.replace("[deformer]", "[deformer]\nmax_steps = 0")
    return at.run()


@case("tiny.toml", "tets.edge_length_fraction", "found 2.0", "between 0 and 1")
def tet_fraction_out_of_range(at: Place) -> Sequence[str]:
    return at.run("--set", "tets.edge_length_fraction=2.0")


@case("tiny.toml", "limits.bone_rigidity_mm", "found -1", "at least 0")
def negative_limit(at: Place) -> Sequence[str]:
    at.replace("bone_rigidity_mm = 2.0", "bone_rigidity_mm = -1.0")
    return at.run()


@case("tiny.toml", "deformer.kernel", "'r4'", "isochoric-r3")
def unknown_value(at: Place) -> Sequence[str]:
    at.replace('"r3"', '"r4"')
    return at.run()


@case("tiny.toml", "drive.source", "missing")
def missing_key(at: Place) -> Sequence[str]:
    at.replace('source = "landmarks.csv"\n', "")
    return at.run()


@case("tiny.toml", "anatomy", "builtin and folder", "exactly one")
def two_anatomies(at: Place) -> Sequence[str]:
    at.replace("[anatomy]", '[anatomy]\nbuiltin = "upper_limb"')
    return at.run()


@case("tiny.toml", "not UTF-8", "byte", "save it as UTF-8")
def rig_is_not_utf8(at: Place) -> Sequence[str]:
    at.rig.write_bytes(at.rig.read_bytes().replace(b"Four", b"Vi\xe4r"))
    return at.run()


@case("{rig.parent}", "folder", "name the rig file")
def rig_is_a_folder(at: Place) -> Sequence[str]:
    return ["run", str(at.rig.parent), "--out", str(at.out)]


@case("gone.toml", "no such rig file", "upper_limb")
def rig_is_missing(at: Place) -> Sequence[str]:
    return ["run", str(at.rig.with_name("gone.toml")), "--out", str(at.out)]


@case("'uper_limb'", "did you mean 'upper_limb'?")
def unknown_rig_name(at: Place) -> Sequence[str]:
    return ["run", "uper_limb", "--out", str(at.out)]


# --- the anatomy


@case("anatomy.folder", "{anatomy}", "does not exist", "relative ones start at the rig's folder")
def missing_anatomy_folder(at: Place) -> Sequence[str]:
    at.anatomy.rename(at.anatomy.with_name("elsewhere"))
    return at.run()


@case("{anatomy}", "no surface file", ".stl, .obj, .ply, .vtp")
def empty_anatomy_folder(at: Place) -> Sequence[str]:
    for path in at.anatomy.iterdir():
        path.unlink()
    return at.run()


@case("is a file, not a folder", "files")
def anatomy_folder_is_a_file(at: Place) -> Sequence[str]:
    at.replace('"anatomy"', '"anatomy/skin.ply"')
    return at.run()


@case("{bone}", "an empty file", "export")
def empty_mesh_file(at: Place) -> Sequence[str]:
    at.bone.write_bytes(b"")
    return at.run()


@case("{bone}", "empty surface", "0 faces")
def mesh_without_faces(at: Place) -> Sequence[str]:
    at.bone.write_bytes(ply_bytes(TriMesh(np.eye(3), np.zeros((0, 3), np.int64))))
    return at.run()


@case("{bone}", "ends within its 320 face", "export")
def truncated_ply(at: Place) -> Sequence[str]:
    at.bone.write_bytes(at.bone.read_bytes()[:-100])
    return at.run()


def _exported(at: Place, ending: str, *, keep: float) -> Sequence[str]:
    """The bone as another format, cut off after a part of its bytes."""
    surface = TISSUES["bone_distal"]
    data = trimesh.Trimesh(surface.vertices, surface.faces, process=False).export(file_type=ending)
    data = data.encode() if isinstance(data, str) else data
    at.bone.unlink()
    at.bone.with_suffix(f".{ending}").write_bytes(data[: int(keep * len(data))])
    return at.run()


@case("bone_distal.stl", "320 triangles", "export")
def truncated_binary_stl(at: Place) -> Sequence[str]:
    return _exported(at, "stl", keep=0.8)


@case("bone_distal.stl", "endsolid", "export")
def truncated_ascii_stl(at: Place) -> Sequence[str]:
    arguments = _exported(at, "stl_ascii", keep=0.8)
    (at.anatomy / "bone_distal.stl_ascii").rename(at.anatomy / "bone_distal.stl")
    return arguments


@case("bone_distal.obj", "bone_distal", "not closed")
def truncated_obj(at: Place) -> Sequence[str]:
    return _exported(at, "obj", keep=0.8)


@case("bone_distal.vtp", "not a whole VTK XML file", "</VTKFile>", "export")
def truncated_vtp(at: Place) -> Sequence[str]:
    import pyvista as pv

    surface = TISSUES["bone_distal"]
    path = at.bone.with_suffix(".vtp")
    pv.PolyData.from_regular_faces(np.array(surface.vertices), np.array(surface.faces)).save(path)
    path.write_bytes(path.read_bytes()[:-200])
    at.bone.unlink()
    return at.run()


@case("{bone}", "not a PLY file", "export")
def garbage_bytes(at: Place) -> Sequence[str]:
    at.bone.write_bytes(bytes(range(256)) * 40)
    return at.run()


@case("bone_distal.obj", "line 1", "not a statement")
def garbage_text(at: Place) -> Sequence[str]:
    at.bone.unlink()
    at.bone.with_suffix(".obj").write_text("<html>404</html>\n", encoding="utf-8")
    return at.run()


def _rewritten(at: Place, vertices: np.ndarray, faces: np.ndarray) -> Sequence[str]:
    """The bone as ASCII PLY, which holds anything."""
    lines = [f"{x} {y} {z}" for x, y, z in vertices] + [f"3 {a} {b} {c}" for a, b, c in faces]
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty double x\nproperty double y\n"
        f"property double z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    at.bone.write_text(header + "\n".join(lines) + "\n", encoding="utf-8")
    return at.run()


@case("{bone}", "'bone_distal' is not closed", "4 boundary edges around 1 hole", "musclefit repair IN OUT")
def open_mesh(at: Place) -> Sequence[str]:
    surface = TISSUES["bone_distal"]
    first, *others = (set(face) for face in surface.faces.tolist())
    neighbour = 1 + next(k for k, face in enumerate(others) if len(face & first) == 2)
    return _rewritten(at, surface.vertices, np.delete(surface.faces, [0, neighbour], axis=0))


@case("{bone}", "1 of 162 vertices are not finite", "number 7", "nan", "export")
def nan_vertex(at: Place) -> Sequence[str]:
    vertices = np.array(TISSUES["bone_distal"].vertices)
    vertices[7, 1] = np.nan
    return _rewritten(at, vertices, TISSUES["bone_distal"].faces)


@case("{bone}", "face 3", "vertex 162", "there are 162")
def face_beyond_the_vertices(at: Place) -> Sequence[str]:
    faces = np.array(TISSUES["bone_distal"].faces)
    faces[3, 1] = 162
    return _rewritten(at, TISSUES["bone_distal"].vertices, faces)


@case("{bone}", "encloses no volume", "musclefit repair IN OUT --thicken-mm")
def flat_mesh(at: Place) -> Sequence[str]:
    return _rewritten(at, TISSUES["bone_distal"].vertices * (1, 1, 0), TISSUES["bone_distal"].faces)


@case("{bone}", "cannot be a place of a body (at most 1e+09)", "units")
def absurd_coordinate(at: Place) -> Sequence[str]:
    return _rewritten(at, TISSUES["bone_distal"].vertices * 1e12, TISSUES["bone_distal"].faces)


def _shrunk(at: Place, factor: float) -> None:
    for name, surface in TISSUES.items():
        scaled = TriMesh(surface.vertices * factor, surface.faces)
        (at.anatomy / f"{name}.ply").write_bytes(ply_bytes(scaled))


@case("0.144", "mm across", "metres", 'units = "m"')
def metres_taken_for_millimetres(at: Place) -> Sequence[str]:
    _shrunk(at, 1e-3)
    return at.run()


@case("mm across", 'units = "mm"', 'read in "m"')
def millimetres_taken_for_metres(at: Place) -> Sequence[str]:
    return at.run("--set", "anatomy.units=m")


@case("bone_distal.obj", "bone_distal.ply", "both be the tissue 'bone_distal'", "rename")
def two_tissues_of_one_name(at: Place) -> Sequence[str]:
    at.bone.with_suffix(".obj").write_bytes(at.bone.read_bytes())
    return at.run()


@case("2 tissues are of kind skin", "skin, skin_old", "[anatomy.kinds]")
def two_skins(at: Place) -> Sequence[str]:
    (at.anatomy / "skin_old.ply").write_bytes((at.anatomy / "skin.ply").read_bytes())
    return at.run()


@case("bone_distal.vtk", ".stl, .obj, .ply, .vtp", "not .vtk")
def unsupported_ending(at: Place) -> Sequence[str]:
    at.bone.rename(at.bone.with_suffix(".vtk"))
    at.replace('folder = "anatomy"', 'files = ["anatomy/skin.ply", "anatomy/bone_distal.vtk"]')
    return at.run()


@case("anatomy.files", "gone.ply", "does not exist")
def missing_file_of_a_list(at: Place) -> Sequence[str]:
    at.replace('folder = "anatomy"', 'files = ["anatomy/gone.ply"]')
    return at.run()


@case("is a folder", "*.ply")
def folder_in_a_list_of_files(at: Place) -> Sequence[str]:
    at.replace('folder = "anatomy"', 'files = ["anatomy"]')
    return at.run()


@case("anatomy.kinds.skin", "'hide'", "skin")
def unknown_kind(at: Place) -> Sequence[str]:
    at.replace("[drive]", '[anatomy.kinds]\nskin = "hide"\n[drive]')
    return at.run()


@case("'femur*'", "no tissue is named", "bone_distal")
def kind_for_no_tissue(at: Place) -> Sequence[str]:
    at.replace("[drive]", '[anatomy.kinds]\n"femur*" = "bone"\n[drive]')
    return at.run()


@case("anatomy.folder", "MUSCLEFIT_DATA", "is set to /nowhere/at/all", "set MUSCLEFIT_DATA to the folder of the data")
def data_variable_points_nowhere(at: Place) -> Sequence[str]:
    return ["run", "forearm", "--out", str(at.out)]


# --- landmarks and cages


def _with_landmarks(at: Place, edit: Callable[[list[list[str]]], object]) -> Sequence[str]:
    rows = landmark_rows()
    edit(rows)
    write_landmarks(at.landmarks, rows)
    return at.run()


@case("drive.source", "{landmarks}", "does not exist")
def missing_landmark_file(at: Place) -> Sequence[str]:
    at.landmarks.unlink()
    return at.run()


@case("{landmarks}", "an empty file", "export")
def empty_landmark_file(at: Place) -> Sequence[str]:
    at.landmarks.write_text("", encoding="utf-8")
    return at.run()


@case("{landmarks}", "no landmark", "one row per landmark")
def landmark_file_with_headings_alone(at: Place) -> Sequence[str]:
    return _with_landmarks(at, lambda rows: rows.__delitem__(slice(1, None)))


@case("landmarks.txt", ".csv, .fcsv, .mrk.json and .trc")
def landmark_file_of_another_ending(at: Place) -> Sequence[str]:
    at.landmarks.rename(at.landmarks.with_suffix(".txt"))
    at.replace("landmarks.csv", "landmarks.txt")
    return at.run()


@case("{landmarks}", "two landmarks are named 'bone_distal_2'", "rename")
def duplicate_landmark_names(at: Place) -> Sequence[str]:
    return _with_landmarks(at, lambda rows: rows[1].__setitem__(0, "bone_distal_2"))


@case("{landmarks}", "'bone_proximal_0' and 'bone_proximal_1' stand at one place", "correct or leave out")
def two_landmarks_at_one_place(at: Place) -> Sequence[str]:
    return _with_landmarks(at, lambda rows: rows[2].__setitem__(slice(2, 5), rows[1][2:5]))


@case("{landmarks}", "'bone_proximal_0' and 'bone_proximal_1' are sent to one place", "no one-to-one map")
def two_landmarks_sent_to_one_place(at: Place) -> Sequence[str]:
    return _with_landmarks(at, lambda rows: rows[2].__setitem__(slice(5, 8), rows[1][5:8]))


@case("'bone_proximal_0' and 'bone_proximal_1' are sent to one place", "remove or correct")
def two_landmarks_sent_almost_to_one_place(at: Place) -> Sequence[str]:
    def edit(rows: list[list[str]]) -> None:
        rows[2][5:8] = rows[1][5:8]
        rows[2][5] = repr(float(rows[1][5]) + 1e-7)

    return _with_landmarks(at, edit)


@case("'bone_proximal_0'", "bone 'bone_distl'", "did you mean 'bone_distal'?")
def unknown_bone_in_landmarks(at: Place) -> Sequence[str]:
    return _with_landmarks(at, lambda rows: rows[1].__setitem__(1, "bone_distl"))


@case("{landmarks}", "line 4", "y_mm is '1,5e'", "not a number")
def landmark_that_is_no_number(at: Place) -> Sequence[str]:
    rows = landmark_rows()
    rows[3][3] = "1,5e"
    at.landmarks.write_text("\n".join(";".join(row) for row in rows), encoding="utf-8")
    return at.run()


@case("{landmarks}", "line 2", "z_mm is nan", "not finite")
def landmark_that_is_not_finite(at: Place) -> Sequence[str]:
    return _with_landmarks(at, lambda rows: rows[1].__setitem__(4, "nan"))


@case("{landmarks}", "line 3 has 7 values for 8 columns")
def landmark_row_too_short(at: Place) -> Sequence[str]:
    return _with_landmarks(at, lambda rows: rows[2].pop())


@case("{landmarks}", "no column z_mm", "found are: name, bone, x_mm, y_mm")
def missing_column(at: Place) -> Sequence[str]:
    return _with_landmarks(at, lambda rows: [row.pop(4) for row in rows])


@case("{landmarks}", "no target columns", "drive.target")
def landmarks_without_targets(at: Place) -> Sequence[str]:
    return _with_landmarks(at, lambda rows: [[row.pop(5) for _ in range(3)] for row in rows])


@case("landmarks span", "likely wrong units", "drive.units")
def landmarks_in_metres(at: Place) -> Sequence[str]:
    def edit(rows: list[list[str]]) -> None:
        for row in rows[1:]:
            row[2:] = [repr(float(cell) / 1000) for cell in row[2:]]

    return _with_landmarks(at, edit)


@case("'bone_distal_5'", "outside the anatomy", "wrong units or another frame")
def landmark_far_away(at: Place) -> Sequence[str]:
    return _with_landmarks(at, lambda rows: rows[-1].__setitem__(2, "900"))


def _cages(at: Place, target: TriMesh) -> Sequence[str]:
    (at.rig.parent / "cage.ply").write_bytes(ply_bytes(TISSUES["skin"]))
    (at.rig.parent / "caged.ply").write_bytes(ply_bytes(target))
    at.replace(
        'kind = "landmarks"\nsource = "landmarks.csv"', 'kind = "cage"\nsource = "cage.ply"\ntarget = "caged.ply"'
    )
    return at.run()


@case("drive.target", "source cage has 162 vertices", "target cage 42", "same vertices")
def cages_with_different_vertices(at: Place) -> Sequence[str]:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=40.0)
    return _cages(at, TriMesh(np.asarray(ball.vertices), np.asarray(ball.faces)))


@case("drive.target", "320 of 320 triangles", "differ", "same order")
def cages_with_different_triangles(at: Place) -> Sequence[str]:
    return _cages(at, TriMesh(TISSUES["skin"].vertices, np.roll(TISSUES["skin"].faces, 1, axis=0)))


@case("drive.target", "caged.ply", "does not exist")
def missing_cage(at: Place) -> Sequence[str]:
    arguments = _cages(at, TISSUES["skin"])
    (at.rig.parent / "caged.ply").unlink()
    return arguments


# --- joints


def _with_joints(at: Place, old: str, new: str) -> Sequence[str]:
    drive_by_joints(at.rig)
    change(at.joints, old, new)
    return at.run()


@case("drive.joints", "{joints}", "does not exist")
def missing_joints_file(at: Place) -> Sequence[str]:
    drive_by_joints(at.rig)
    at.joints.unlink()
    return at.run()


@case("{joints}", "elbow.moving", "no bone 'bone_dstal'", "did you mean 'bone_distal'?")
def unknown_bone_in_joints(at: Place) -> Sequence[str]:
    return _with_joints(at, "bone_distal", "bone_dstal")


@case("{joints}", "elbow.axis", "[0.0, 0.0, 0.0]", "too short")
def axis_of_no_length(at: Place) -> Sequence[str]:
    return _with_joints(at, "[0, 0, 1]", "[0, 0, 0]")


@case("{joints}", "units", "'inch'", "mm, cm, m")
def joints_in_unknown_units(at: Place) -> Sequence[str]:
    return _with_joints(at, "mm, degrees", "inch")


@case("joints.json", "not valid JSON", "line 2, column")
def broken_json(at: Place) -> Sequence[str]:
    drive_by_joints(at.rig)
    at.replace("joints.toml", "joints.json")
    at.joints.with_suffix(".json").write_text('{"units": "mm",\n', encoding="utf-8")
    return at.run()


@case("drive.pose", "'elbw'", "did you mean 'elbow'?")
def unknown_joint_in_pose(at: Place) -> Sequence[str]:
    drive_by_joints(at.rig)
    at.replace("elbow_deg", "elbw_deg")
    return at.run()


@case("drive.pose", "'elbow'", "found 75 degrees", "[-5, 60]", "inside")
def pose_outside_the_limits(at: Place) -> Sequence[str]:
    drive_by_joints(at.rig)
    return at.run("--set", "drive.pose.elbow_deg=75")


@case("drive.pose", "elbow_rad", "elbow_deg", "degrees")
def pose_in_radians(at: Place) -> Sequence[str]:
    drive_by_joints(at.rig)
    at.replace("elbow_deg", "elbow_rad")
    return at.run()


# --- transforms, and landmarks of rigid bones

_QUATERNIONS = "bone,time_s,qw,qx,qy,qz,x_mm,y_mm,z_mm\n"
_MATRICES = "bone," + ",".join(f"m{i}{j}" for i in range(4) for j in range(4)) + "\n"
_STILL = "bone_distal,0,1,0,0,0,0,0,0\n"


def _with_transforms(at: Place, text: str, *more: str) -> Sequence[str]:
    drive_by(at.rig, 'kind = "transforms"\ntransforms = "moved.csv"')
    at.rig.with_name("moved.csv").write_text(text, encoding="utf-8")
    return at.run(*more)


@case("drive.transforms", "moved.csv", "does not exist")
def missing_transforms(at: Place) -> Sequence[str]:
    arguments = _with_transforms(at, "")
    at.rig.with_name("moved.csv").unlink()
    return arguments


@case("drive.transforms", "moved.csv", "is empty", "m00 to m33")
def empty_transforms(at: Place) -> Sequence[str]:
    return _with_transforms(at, "")


@case("drive.transforms", "line 2", "bone 'bone_distal'", "determinant -1: a mirror", "LPS and RAS")
def transform_that_mirrors(at: Place) -> Sequence[str]:
    return _with_transforms(at, _MATRICES + "bone_distal,1,0,0,0,0,1,0,0,0,0,-1,0,0,0,0,1\n")


@case("line 2", "'bone_distal'", "largest deviation from a rotation 0.02", "scales by 1.02", "expected at most 0.001")
def transform_that_scales(at: Place) -> Sequence[str]:
    return _with_transforms(at, _MATRICES + "bone_distal,1.02,0,0,0,0,1.02,0,0,0,0,1.02,0,0,0,0,1\n")


@case("line 2", "'bone_distal'", "largest deviation from a rotation 0.105", "it shears")
def transform_that_shears(at: Place) -> Sequence[str]:
    return _with_transforms(at, _MATRICES + "bone_distal,1,0.2,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n")


@case("line 2", "last row", "column by column: transpose it")
def transform_column_by_column(at: Place) -> Sequence[str]:
    return _with_transforms(at, _MATRICES + "bone_distal,1,0,0,0,0,1,0,0,0,0,1,0,5,6,7,1\n")


@case("line 3", "'bone_distal' at 0.5 s", "quaternion's length is 1.1")
def quaternion_of_another_length(at: Place) -> Sequence[str]:
    return _with_transforms(at, _QUATERNIONS + _STILL + "bone_distal,0.5,1.1,0,0,0,0,0,0\n")


@case("'bone_distal' at 0 s stands twice", "line 2 and line 3", "remove one")
def transform_given_twice(at: Place) -> Sequence[str]:
    return _with_transforms(at, _QUATERNIONS + _STILL + _STILL)


@case("line 2", "x_mm is nan, not finite")
def transform_that_is_not_finite(at: Place) -> Sequence[str]:
    return _with_transforms(at, _QUATERNIONS + "bone_distal,0,1,0,0,0,nan,0,0\n")


@case("drive.transforms", "a coordinate of 1e+300 mm, which cannot be a place of a body")
def huge_transform(at: Place) -> Sequence[str]:
    return _with_transforms(at, _QUATERNIONS + "bone_distal,0,1,0,0,0,1e300,0,0\n")


@case("drive.transforms", "'bone_distal' at 0 s is sent 9e+04 mm away", "wrong units (drive.units)")
def transforms_in_other_units(at: Place) -> Sequence[str]:
    return _with_transforms(at, _QUATERNIONS.replace("_mm", "_m") + "bone_distal,0,1,0,0,0,90,0,0\n")


@case("drive.transforms", "no bone 'bone_dital'", "did you mean 'bone_distal'?")
def transform_of_an_unknown_bone(at: Place) -> Sequence[str]:
    return _with_transforms(at, _QUATERNIONS + _STILL.replace("distal", "dital"))


@case("drive.transforms", "'muscle_flexor' is of kind 'muscle'", "transforms move bones")
def transform_of_a_muscle(at: Place) -> Sequence[str]:
    return _with_transforms(at, _QUATERNIONS + _STILL.replace("bone_distal", "muscle_flexor"))


@case("drive.time_s", "asked for 3 s", "known from 0 to 0 s")
def time_that_the_transforms_do_not_have(at: Place) -> Sequence[str]:
    return _with_transforms(at, _QUATERNIONS + _STILL, "--set", "drive.time_s=3")


_RIGID = ("--set", "bones.rigid=true", "--set", "deformer.step=cayley")


@case("drive: bones.rigid: the 2 landmarks of bone 'bone_distal'", "leave its turn free", "three or more")
def rigid_bone_with_two_landmarks(at: Place) -> Sequence[str]:
    write_landmarks(at.landmarks, landmark_rows()[:-4])
    return at.run(*_RIGID)


@case("drive: bones.rigid", "'bone_distal' are a mirror image", "(LPS or RAS)")
def mirrored_landmarks(at: Place) -> Sequence[str]:
    rows = landmark_rows()
    rows[7][2:5] = ["40", "5", "9"]  # so that the bone's landmarks are not symmetric
    for row in rows[7:]:
        row[5:8] = [row[2], repr(-float(row[3])), row[4]]
    write_landmarks(at.landmarks, rows)
    return at.run(*_RIGID)


# --- the command line itself


@case("file.txt", "output folder", "name")
def out_below_a_file(at: Place) -> Sequence[str]:
    file = at.rig.with_name("file.txt")
    file.write_text("not a folder", encoding="utf-8")
    return ["run", str(at.rig), "--out", str(file / "below")]


@case("output folder", "is a file", "does not exist yet")
def out_is_a_file(at: Place) -> Sequence[str]:
    return ["run", str(at.rig), "--out", str(at.rig)]


@case("output folder {anatomy}", "not empty", "report.json", "another folder")
def out_is_a_folder_of_something_else(at: Place) -> Sequence[str]:
    return ["run", str(at.rig), "--out", str(at.anatomy)]


@case("current folder", "name a folder inside it")
def out_is_the_current_folder(at: Place) -> Sequence[str]:
    return ["run", str(at.rig), "--out", ""]


@case("deformer.backend", "'fem'", "known", "rbf")
def unknown_backend(at: Place) -> Sequence[str]:
    return at.run("--backend", "fem")


@case("--set deformer.max_steps", "no '='", "--set key=value")
def set_without_a_value(at: Place) -> Sequence[str]:
    return at.run("--set", "deformer.max_steps")


@case("--set deformer.kernl=r3", "unknown key 'deformer.kernl'", "did you mean 'deformer.kernel'?")
def set_of_an_unknown_key(at: Place) -> Sequence[str]:
    return at.run("--set", "deformer.kernl=r3")


@case("deformer.kernel", "'r5'", "r2logr")
def set_to_an_unknown_value(at: Place) -> Sequence[str]:
    return at.run("--set", "deformer.kernel=r5")


@case('--set title="open', "not valid TOML", "quoted text")
def set_to_broken_toml(at: Place) -> Sequence[str]:
    return at.run("--set", 'title="open')


@case('Unknown command "bend"', "demo, run, check")
def unknown_command(at: Place) -> Sequence[str]:
    return ["bend", str(at.rig)]


@case("Unknown option", "--ouf", "--out", "musclefit --help")
def unknown_option(at: Place) -> Sequence[str]:
    return ["run", str(at.rig), "--ouf", str(at.out)]


@case("RIG", "requires an argument", "musclefit --help")
def run_of_nothing(at: Place) -> Sequence[str]:
    return ["run"]


@case("'more'", "musclefit --help")
def too_many_arguments(at: Place) -> Sequence[str]:
    return [*at.run(), "more"]


# --- check


@case("{anatomy}/gone", "no file fits", "correct the path")
def check_of_a_missing_path(at: Place) -> Sequence[str]:
    return ["check", str(at.anatomy / "gone"), "--out", str(at.out)]


@case("PATHS", "requires an argument")
def check_of_nothing(at: Place) -> Sequence[str]:
    return ["check"]


@case("{anatomy}", "no surface file", ".ply")
def check_of_an_empty_folder(at: Place) -> Sequence[str]:
    for path in at.anatomy.iterdir():
        path.unlink()
    return at.check()


@case("{bone}", "not a PLY file", "export")
def check_of_garbage(at: Place) -> Sequence[str]:
    at.bone.write_bytes(b"\x00" * 1000)
    return ["check", str(at.bone), "--out", str(at.out)]


@case("0.144", "mm across", "metres", '"m"')
def check_in_metres(at: Place) -> Sequence[str]:
    _shrunk(at, 1e-3)
    return at.check()


@case("--kind 'skin:skin'", "name=kind", "skin, other, muscle, bone")
def check_with_a_kind_without_equals(at: Place) -> Sequence[str]:
    return at.check("--kind", "skin:skin")


@case("--kind 'skin=hide'", "known kinds: skin, other, muscle, bone")
def check_with_an_unknown_kind(at: Place) -> Sequence[str]:
    return at.check("--kind", "skin=hide")


@case("'femur'", "no tissue is named", "bone_distal")
def check_with_a_kind_for_no_tissue(at: Place) -> Sequence[str]:
    return at.check("--kind", "femur=bone")


@case("--units", "inch", '"mm", "cm", "m"')
def check_in_unknown_units(at: Place) -> Sequence[str]:
    return at.check("--units", "inch")


@case("output folder", "not empty")
def check_into_a_folder_of_something_else(at: Place) -> Sequence[str]:
    return ["check", str(at.anatomy), "--out", str(at.anatomy)]


if sys.platform == "linux":

    @case("{anatomy}", "bone_\\udcff.ply", "not UTF-8", "rename")
    def file_name_that_is_no_text(at: Place) -> Sequence[str]:
        at.bone.rename(at.bone.with_name(os.fsdecode(b"bone_\xff.ply")))
        return at.run()


@pytest.mark.parametrize("broken", CASES, ids=lambda broken: broken.name)
def test_bad_input_is_refused(
    broken: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    at = Place(write_tiny_rig(tmp_path / "rig"), tmp_path / "out" / "result")
    monkeypatch.setenv("MUSCLEFIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("MUSCLEFIT_DATA", "/nowhere/at/all")
    (tmp_path / "current").mkdir()
    monkeypatch.chdir(tmp_path / "current")
    arguments = list(broken.arrange(at))
    before = everything_below(tmp_path)

    code = main(arguments)

    told = capsys.readouterr()
    assert code == 2, told
    assert told.out == ""
    assert told.err.startswith("musclefit: ")
    assert "Traceback" not in told.err
    for words in broken.words:
        assert (
            words.format(**{name: getattr(at, name) for name in ("anatomy", "bone", "landmarks", "joints", "rig")})
            in told.err
        )
    assert everything_below(tmp_path) == before
    assert Path.cwd() == tmp_path / "current"


def test_there_are_enough_cases() -> None:
    assert len(CASES) == len({broken.name for broken in CASES}) >= 30


def everything_below(folder: Path) -> dict[Path, bytes | None]:
    """Every file with its bytes, and every folder, also those with names that begin with a dot."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}
