"""The readers of files from elsewhere, with good files of each, for ``python tests/reader_fuzzing.py``."""

from __future__ import annotations

import gzip
import io
import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

Examples = Callable[[], list[bytes]]


@dataclass(frozen=True)
class Reader:
    """A reader: its name, the ending of its files, what reads one, and good files of it."""

    name: str
    ending: str
    read: Callable[[Path], object]
    examples: Examples


# Good files


def _ball() -> Any:
    import trimesh

    return trimesh.creation.icosphere(0, radius=10.0)


def _plys() -> list[bytes]:
    from musclefit.geometry.meshes import TriMesh
    from musclefit.io.run_folder import ply_bytes

    ball = _ball()
    text = ball.export(file_type="ply", encoding="ascii")
    strips = (
        b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        b"element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
        b"0 0 0\n1 0 0\n0 1 0\n1 1 0\n7 0 1 2 -1 1 3 2\n"
    )
    return [ply_bytes(TriMesh(ball.vertices, ball.faces)), text, ball.export(file_type="ply"), strips]


def _stls() -> list[bytes]:
    return [_ball().export(file_type="stl"), _ball().export(file_type="stl_ascii").encode()]


def _objs() -> list[bytes]:
    return [_ball().export(file_type="obj").encode(), b"v 0 0 0\nv 2 0 0\nv 1 1 0\nv 0 2 0\nf 1/1/1 2//2 -2 -1\n"]


def _vtk_files(make: Callable[[], Any], writer: Callable[[], Any]) -> list[bytes]:
    found = []
    for mode in ("Ascii", "Binary", "Appended"):
        for packed in (False, True):
            out = writer()
            out.SetInputData(make())
            getattr(out, f"SetDataModeTo{mode}")()
            out.EncodeAppendedDataOff()
            if not packed:
                out.SetCompressor(None)
            with tempfile.TemporaryDirectory() as folder:
                out.SetFileName(f"{folder}/file")
                out.Write()
                found.append((Path(folder) / "file").read_bytes())
    return found


def _vtps() -> list[bytes]:
    import pyvista as pv
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    def mesh() -> Any:
        surface = pv.PolyData.from_regular_faces(np.array(_ball().vertices), np.array(_ball().faces))
        surface.point_data["load"] = np.arange(12.0)
        return surface

    return _vtk_files(mesh, vtkXMLPolyDataWriter)


def _grid() -> Any:
    import pyvista as pv

    grid = pv.UnstructuredGrid(
        {pv.CellType.TETRA: np.array([[0, 1, 2, 3], [1, 2, 3, 4]])}, np.random.default_rng(0).normal(size=(5, 3))
    )
    grid.cell_data["tissue"] = np.array([0, 1])
    grid.point_data["rest_position_mm"] = np.zeros((5, 3))
    grid.field_data["bone"], grid.field_data["muscle"] = np.array([0, 3]), np.array([1, 3])
    return grid


def _vtus() -> list[bytes]:
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    return _vtk_files(_grid, vtkXMLUnstructuredGridWriter)


def _niftis() -> list[bytes]:
    import nibabel

    found = []
    for dtype in (np.uint8, np.int16, np.float32):
        data = np.arange(60).reshape(3, 4, 5).astype(dtype)
        image = nibabel.Nifti1Image(data, np.diag([1.0, 2.0, 3.0, 1.0]))
        image.header.set_xyzt_units("mm")
        found.append(image.to_bytes())
    return found


def _packed_niftis() -> list[bytes]:
    return [gzip.compress(data) for data in _niftis()]


def _nrrds() -> list[bytes]:
    import nrrd

    found = []
    segments = {"Segment0_Name": "a", "Segment0_LabelValue": "1", "Segment0_Layer": "0", "Segment1_Name": "b"}
    segments |= {"Segment1_LabelValue": "2", "Segment1_Layer": "1"}
    for layers, encoding in ((1, "raw"), (1, "gzip"), (2, "gzip"), (1, "ascii")):
        directions = np.diag([1.0, 2.0, 3.0])
        header: dict[str, Any] = {
            "space": "left-posterior-superior",
            "space origin": [0.0, 1.0, 2.0],
            "encoding": encoding,
        }
        data = np.arange(60 * layers).reshape(layers, 3, 4, 5).astype(np.uint8) % 3
        if layers > 1:
            header |= {"space directions": np.vstack([[np.nan] * 3, directions]), **segments}
        else:
            data, header = data[0], header | {"space directions": directions}
        with tempfile.TemporaryDirectory() as folder:
            nrrd.write(f"{folder}/a.nrrd", data, header)
            found.append(Path(folder, "a.nrrd").read_bytes())
    return found


def _landmark_tables() -> list[bytes]:
    return [
        b"name,bone,x_mm,y_mm,z_mm,target_x_mm,target_y_mm,target_z_mm\nA,hum,1,2,3,4,5,6\nB,uln,7,8,9,1,2,3\n",
        b"name;x;y;z\nA;1;2;3\nB;4;5;6.5\n",
    ]


FCSV = (
    b"# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n"
    b"# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    b'1,1,2,3,0,0,0,1,1,1,0,elbow,"a, b",\n2,-4.5,50,6,0,0,0,1,1,1,0,wrist,,\n'
)
MARKUPS = {
    "markups": [
        {
            "type": "Fiducial",
            "coordinateSystem": "LPS",
            "coordinateUnits": "mm",
            "controlPoints": [
                {"label": "a", "position": [0.1, 0.2, 0.3], "positionStatus": "defined"},
                {"label": "b", "position": [5.0, 0.0, 0.5]},
            ],
        }
    ]
}
TRC = (
    b"PathFileType\t4\t(X/Y/Z)\tt.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\n"
    b"100\t100\t2\t2\tmm\t100\nFrame#\tTime\tA\t\t\tB\t\t\n\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n\n"
    b"1\t0.0\t1\t2\t3\t4\t5\t6\n2\t0.01\t1.5\t2\t3\t\t\t\n"
)
TRANSFORMS = {
    "units": "mm",
    "transforms": [
        {"bone": "ulna", "time_s": 0.0, "matrix": np.eye(4).tolist()},
        {"bone": "ulna", "time_s": 1.0, "quaternion_wxyz": [1, 0, 0, 0], "translation_mm": [1, 2, 3]},
    ],
}


# What reads them


def _surface(path: Path) -> object:
    from musclefit.io.anatomy import read_surface

    return read_surface(path).mesh()


def _points(path: Path) -> object:
    from musclefit.io.formats.points import read_points
    from musclefit.vocabulary import Unit

    read = read_points(path, units=Unit.METRE)
    read.rewrite(read.points + 1.0, path.with_name(f"moved-{path.name}"))
    return read


def _landmarks(path: Path) -> object:
    from musclefit.io.formats.landmarks import read_landmarks

    return read_landmarks(path)


def _volume(path: Path) -> object:
    from musclefit.io.formats.nifti import read_volume

    return read_volume(path)


def _segmentation(path: Path) -> object:
    from musclefit.io.segmentations import read_segmentation

    return read_segmentation(path)


def _named_values(path: Path) -> object:
    from musclefit.io.label_names import read_names

    return read_names(path)


def _label_names(path: Path) -> object:
    from musclefit.io.label_maps import read_label_names

    return read_label_names(path)


def _motion(path: Path) -> object:
    from musclefit.io.formats.motions import read_motion

    return read_motion(path)


def _lattice(path: Path) -> object:
    from musclefit.io.formats.control_points import read_displacements
    from musclefit.vocabulary import Unit

    return read_displacements(path, shape=(3, 3, 3), units=Unit.METRE)


def _transforms(path: Path) -> object:
    from musclefit.io.formats.transforms import parse_transforms
    from musclefit.vocabulary import Unit

    return parse_transforms(path.read_bytes(), source=str(path), units=Unit.METRE)


def _joints(path: Path) -> object:
    from musclefit.io.formats.tables import parse_table
    from musclefit.rig.joints import parse_joints

    return parse_joints(parse_table(path.read_bytes(), source=str(path)), source=str(path))


def _joint_files() -> list[bytes]:
    from tiny_rigs import JOINTS

    return [JOINTS.encode()]


@cache
def _rig_folder() -> Path:
    from tiny_rigs import JOINTS, write_tiny_rig

    rig = write_tiny_rig(Path(tempfile.mkdtemp(prefix="musclefit-rig-")))
    (rig.parent / "joints.toml").write_text(JOINTS)
    return rig.parent


def _rig(path: Path) -> object:
    from musclefit.io.rigs import read_rig

    inside = _rig_folder() / "fuzzed.toml"
    inside.write_bytes(path.read_bytes())
    return read_rig(inside)


def _rig_files() -> list[bytes]:
    from tiny_rigs import JOINT_DRIVE, RIG

    joints = RIG.replace(RIG[RIG.index("[drive]") : RIG.index("[deformer]")], JOINT_DRIVE + "\n")
    return [RIG.encode(), joints.encode()]


def _run_tets(path: Path) -> object:
    from musclefit.io.run_tets import Shape, read_run_tets

    (path.parent / "report.json").write_text('{"title": "a"}')
    (path.parent / "tets.vtu").write_bytes(path.read_bytes())
    return [read_run_tets(path.parent, shape=shape) for shape in Shape]


def _recording(path: Path) -> object:
    from musclefit.io.marker_motions import MarkerFrame, read_recording

    return read_recording(path.read_bytes(), source=str(path), frame=MarkerFrame())


def _recording_c3d(path: Path) -> object:
    from musclefit.io.marker_motions import MarkerFrame, Up, read_recording

    return read_recording(path.read_bytes(), source=str(path), frame=MarkerFrame(Up.Y))


WRITE_C3D = """
import sys
import ezc3d
import numpy as np
made = ezc3d.c3d()
made["parameters"]["POINT"]["RATE"]["value"] = [100.0]
made["parameters"]["POINT"]["LABELS"]["value"] = ["subject:A", "B"]
made["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
made["data"]["points"] = np.ones((4, 2, 3))
made.write(sys.argv[1])
"""
"""In a process of its own: beside OpenSim's library ezc3d takes vectors for those of another kind."""


def _recordings_c3d() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.c3d"
        subprocess.run([sys.executable, "-c", WRITE_C3D, str(path)], check=True)
        return [path.read_bytes()]


def _measures(path: Path) -> object:
    from musclefit.io.formats.body_measures import read_body_measures

    return read_body_measures(path)


def _deck(path: Path) -> object:
    from musclefit.io.decks import read_deck

    return read_deck(path)


MEASURES = {
    "stature": {"kind": "stature", "value": 178, "unit": "cm"},
    "waist": {"kind": "girth", "value": 92.5, "unit": "cm", "height": 105},
    "arm": {"kind": "length", "value": 0.33, "unit": "m", "from": "a", "to": "b"},
}
MEASURES_TOML = b"""[measures]
stature = { kind = "stature", value = 178, unit = "cm" }
calf = { kind = "girth", value = 38, unit = "cm", at = "c", from = "a", to = "b" }
"""
MEASURES_CSV = b"name,kind,value,unit,height,at,from,to\nstature,stature,178,cm,,,,\nwaist,girth,920,mm,1050,,,\n"
ATTACHMENTS = (
    b"muscle,end,bone,within_mm\na,origin,hum,3\nb,insertion,,\n",
    b"muscle,end,bone,within_mm,vertices,sheet\na,origin,hum + rad,3,,plate\na,insertion,,,0 1 2,\nb,origin,,,,plate\n",
    b"muscle,end,bone,sheet\na,origin,hum,own.ply\na,insertion,,plate\n",
)
KEYWORDS = (
    b"*KEYWORD\n*NODE\n       1             0.0             0.0             0.0\n"
    b"       2             1.0             0.0             0.0\n"
    b"       3             0.0             1.0             0.0\n"
    b"       4             0.0             0.0             1.0\n*ELEMENT_SOLID\n"
    b"       1       1       1       2       3       4       4       4       4       4\n*END\n"
)
ABAQUS = (
    b"*HEADING\na\n*NODE\n1, 0., 0., 0.\n2, 1., 0., 0.\n3, 0., 1., 0.\n4, 0., 0., 1.\n"
    b"*ELEMENT, TYPE=C3D4, ELSET=bone\n1, 1, 2, 3, 4\n"
)
FEBIO = (
    b'<?xml version="1.0"?>\n<febio_spec version="4.0"><Mesh><Nodes name="a"><node id="1">0,0,0</node>'
    b'<node id="2">1,0,0</node><node id="3">0,1,0</node><node id="4">0,0,1</node></Nodes>'
    b'<Elements type="tet4" name="bone"><elem id="1">1,2,3,4</elem></Elements></Mesh></febio_spec>\n'
)


def _osim(path: Path) -> object:
    from musclefit.io.formats.osim import parse_osim
    from musclefit.io.opensim_geometry import find_geometry, placed_meshes

    model = parse_osim(path.read_bytes(), source=str(path))
    files, _ = find_geometry(model, [path.parent])
    return placed_meshes(model, files)


def _osims() -> list[bytes]:
    from tiny_osim import MODEL

    return [MODEL.encode()]


@cache
def _multibody() -> Any:
    from tiny_osim import MODEL

    from musclefit.io.formats.osim import parse_osim

    return parse_osim(MODEL.encode(), source="tiny.osim").multibody


def _coordinates(path: Path) -> object:
    from musclefit.io.formats.opensim_motion import parse_opensim_motion

    return parse_opensim_motion(path.read_bytes(), _multibody(), source=str(path))


def _coordinate_files() -> list[bytes]:
    from tiny_osim import MOTION

    return [MOTION.encode(), MOTION.replace("\tknee", "\t/jointset/knee/knee/value").encode()]


def _attachments(path: Path) -> object:
    from musclefit.geometry.meshes import TriMesh
    from musclefit.io.formats.attachments import read_attachments

    (path.parent / "own.ply").write_bytes(_plys()[0])
    return read_attachments(path, tissues={"plate": TriMesh(_ball().vertices, _ball().faces)})


def _fibres(path: Path) -> object:
    from musclefit.io.formats.fibre_directions import read_fibres

    return read_fibres(path)


def _fibre_files() -> list[bytes]:
    from musclefit.geometry.meshes import TriMesh
    from musclefit.io.formats.fibre_directions import HeldArea, MuscleFibres, fibre_bytes

    area = HeldArea("bone", TriMesh(np.eye(3), np.array([[0, 1, 2]])))
    one = MuscleFibres(np.zeros((4, 3)), np.ones((4, 3)), (area,))
    other = MuscleFibres(np.ones((2, 3)), np.ones((2, 3)))
    return [fibre_bytes({"a": one, "b": other})]


def _given_fibres(path: Path) -> object:
    from musclefit.io.given_fibres import FibreFiles, read_given_fibres

    return read_given_fibres(FibreFiles(path), anatomy_frame="patient (LPS), mm", muscles=["biceps"])


def _bundle() -> list[Any]:
    return [np.random.default_rng(k).normal(size=(5 + k, 3)).astype(np.float32) for k in range(4)]


def _tractograms(ending: str) -> Examples:
    def made() -> list[bytes]:
        from nibabel.streamlines import Tractogram, detect_format

        found = io.BytesIO()
        bundle = Tractogram(_bundle(), affine_to_rasmm=np.eye(4))
        detect_format(f"a{ending}")(bundle).save(found)
        return [found.getvalue()]

    return made


def _legacy_vtks() -> list[bytes]:
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter, vtkUnstructuredGridWriter

    return [
        *_legacy_vtk(polylines(_bundle()), vtkPolyDataWriter),
        *_legacy_vtk(_fibre_grid(), vtkUnstructuredGridWriter),
    ]


def _legacy_vtk(mesh: Any, writer: Callable[[], Any]) -> list[bytes]:
    found = []
    for version in (42, 51):
        for binary in (False, True):
            out = writer()
            out.SetInputData(mesh)
            out.SetFileVersion(version)
            out.SetFileTypeToBinary() if binary else out.SetFileTypeToASCII()
            with tempfile.TemporaryDirectory() as folder:
                out.SetFileName(f"{folder}/file")
                out.Write()
                found.append((Path(folder) / "file").read_bytes())
    return found


def polylines(lines: list[Any]) -> Any:
    """Lines as VTK has them, with a number for each."""
    import pyvista as pv

    mesh = pv.PolyData()
    mesh.points = np.concatenate(lines)
    ends = np.cumsum([0, *(len(line) for line in lines)])
    mesh.lines = np.concatenate([[b - a, *range(a, b)] for a, b in itertools.pairwise(ends)])
    mesh.cell_data["bundle"] = np.arange(len(lines))
    mesh.point_data["FA"] = np.linspace(0.0, 1.0, ends[-1])
    return mesh


def _fibre_grid() -> Any:
    grid = _grid()
    grid.cell_data["fibres"] = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    return grid


def _fibre_vtus() -> list[bytes]:
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    return _vtk_files(_fibre_grid, vtkXMLUnstructuredGridWriter)


def _fibre_vtps() -> list[bytes]:
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    return _vtk_files(lambda: polylines(_bundle()), vtkXMLPolyDataWriter)


def _study(path: Path) -> object:
    from musclefit.io.studies import read_study

    inside = _rig_folder() / "study.toml"
    inside.write_bytes(path.read_bytes())
    return read_study(inside)


def _any_rig() -> str:
    return next(path.name for path in sorted(_rig_folder().glob("*.toml")) if "[anatomy]" in path.read_text())


def _studies() -> list[bytes]:
    (_rig_folder() / "subjects.csv").write_text("subject,side\nA,left\nB,right\n")
    return [
        b'title = "two"\n[subjects]\ntable = "subjects.csv"\n[rigs]\none = "RIG"\n'.replace(b"RIG", _any_rig().encode())
        + b"[set]\nlimits.landmark_mm = 0.1\n[run]\npictures = false\n"
    ]


def _given(*files: bytes) -> Examples:
    return lambda: list(files)


MARKUP_FILE = json.dumps(MARKUPS).encode()
LATTICE = b"i,j,k,dx,dy,dz\n0,1,2,1,0,0\n2,2,2,0,0.5,0\n"
READERS = (
    Reader("surface ply", ".ply", _surface, _plys),
    Reader("surface stl", ".stl", _surface, _stls),
    Reader("surface obj", ".obj", _surface, _objs),
    Reader("surface vtp", ".vtp", _surface, _vtps),
    Reader("points ply", ".ply", _points, _plys),
    Reader("points obj", ".obj", _points, _objs),
    Reader("points stl", ".stl", _points, _stls),
    Reader("points vtp", ".vtp", _points, _vtps),
    Reader("points vtu", ".vtu", _points, _vtus),
    Reader("points csv", ".csv", _points, _given(b"muscle;x_cm;y_cm;z_cm\na;1;2;3\nb;4;5;6\n", b"x,y,z\n1,2,3\n")),
    Reader("points fcsv", ".fcsv", _points, _given(FCSV)),
    Reader("points markups", ".mrk.json", _points, _given(MARKUP_FILE)),
    Reader("points trc", ".trc", _points, _given(TRC)),
    Reader("landmarks csv", ".csv", _landmarks, _landmark_tables),
    Reader("landmarks fcsv", ".fcsv", _landmarks, _given(FCSV)),
    Reader("landmarks markups", ".mrk.json", _landmarks, _given(MARKUP_FILE)),
    Reader("landmarks trc", ".trc", _landmarks, _given(TRC)),
    Reader("image nii", ".nii", _volume, _niftis),
    Reader("image nii.gz", ".nii.gz", _volume, _packed_niftis),
    Reader("labels nii", ".nii", _segmentation, _niftis),
    Reader("labels nii.gz", ".nii.gz", _segmentation, _packed_niftis),
    Reader("labels nrrd", ".seg.nrrd", _segmentation, _nrrds),
    Reader("names csv", ".csv", _named_values, _given(b"index,structure\n1,biceps\n2,ulna\n")),
    Reader("names json", ".json", _named_values, _given(b'{"labels": {"background": 0, "femur": 1, "tibia": 2}}')),
    Reader("names ctbl", ".ctbl", _named_values, _given(b'# Color\n0 none 0 0 0 0\n1 "a b" 255 0 0 255\n')),
    Reader("label names", ".csv", _label_names, _given(b"value,name,kind\n1,biceps,muscle\n2,ulna,bone\n")),
    Reader("motion csv", ".csv", _motion, _given(b"time_s,elbow_deg,phase\n0,0,a\n0.5,10,b\n1,20,c\n")),
    Reader("lattice csv", ".csv", _lattice, _given(LATTICE)),
    Reader("transforms json", ".json", _transforms, _given(json.dumps(TRANSFORMS).encode())),
    Reader("transforms csv", ".csv", _transforms, _given(b"bone,qw,qx,qy,qz,x_mm,y_mm,z_mm\nulna,1,0,0,0,1,2,3\n")),
    Reader("joints toml", ".toml", _joints, _joint_files),
    Reader("rig toml", ".toml", _rig, _rig_files),
    Reader("recording trc", ".trc", _recording, _given(TRC)),
    Reader("recording c3d", ".c3d", _recording_c3d, _recordings_c3d),
    Reader("measures toml", ".toml", _measures, _given(MEASURES_TOML)),
    Reader("measures json", ".json", _measures, _given(json.dumps({"measures": MEASURES}).encode())),
    Reader("measures csv", ".csv", _measures, _given(MEASURES_CSV)),
    Reader("deck k", ".k", _deck, _given(KEYWORDS)),
    Reader("deck inp", ".inp", _deck, _given(ABAQUS)),
    Reader("deck feb", ".feb", _deck, _given(FEBIO)),
    Reader("model osim", ".osim", _osim, _osims),
    Reader("motion mot", ".mot", _coordinates, _coordinate_files),
    Reader("motion sto", ".sto", _coordinates, _coordinate_files),
    Reader("attachments csv", ".csv", _attachments, _given(*ATTACHMENTS)),
    Reader("fibres npz", ".npz", _fibres, _fibre_files),
    Reader("known fibres tck", ".tck", _given_fibres, _tractograms(".tck")),
    Reader("known fibres trk", ".trk", _given_fibres, _tractograms(".trk")),
    Reader("known fibres vtk", ".vtk", _given_fibres, _legacy_vtks),
    Reader("known fibres vtp", ".vtp", _given_fibres, _fibre_vtps),
    Reader("known fibres vtu", ".vtu", _given_fibres, _fibre_vtus),
    Reader("study toml", ".toml", _study, _studies),
    Reader("tets of a run", ".vtu", _run_tets, _vtus),
)
