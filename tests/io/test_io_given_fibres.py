"""Files of fibres: what VTK's own writers and nibabel write is read as it was, in the anatomy's frame and in mm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from fuzzed_readers import polylines
from nibabel.streamlines import Tractogram, save
from vtkmodules.vtkIOLegacy import vtkPolyDataWriter, vtkUnstructuredGridWriter

from musclefit.errors import InputError, MeshError
from musclefit.geometry.images.grids import Frame
from musclefit.io.formats.vtk_legacy import read_legacy_vtk
from musclefit.io.formats.vtk_lines import vtk_lines
from musclefit.io.given_fibres import FibreFiles, read_given_fibres
from musclefit.muscles.given_fibres import FibreSamples
from musclefit.vocabulary import Unit

LINES = [np.random.default_rng(k).normal(size=(4 + k, 3)) * 30.0 for k in range(3)]
FLIP = np.array([-1.0, -1.0, 1.0])
UNKNOWN = "as in the files"


def read(path: Path, anatomy_frame: str = UNKNOWN, **stated: Any) -> FibreSamples:
    (found,), _ = read_given_fibres(FibreFiles(path, **stated), anatomy_frame=anatomy_frame, muscles=["biceps"])
    return found


def grid() -> pv.UnstructuredGrid:
    mesh = pv.ImageData(dimensions=(3, 3, 3)).cast_to_unstructured_grid()
    rng = np.random.default_rng(3)
    mesh.cell_data["fibres"] = rng.normal(size=(mesh.n_cells, 3))
    mesh.cell_data["tissue"] = np.arange(mesh.n_cells)
    mesh.point_data["load"] = rng.normal(size=(mesh.n_points, 3)).astype(np.float32)
    return mesh


def write_legacy(mesh: Any, path: Path, *, version: int, binary: bool) -> Path:
    out = vtkPolyDataWriter() if isinstance(mesh, pv.PolyData) else vtkUnstructuredGridWriter()
    out.SetInputData(mesh)
    out.SetFileVersion(version)
    out.SetFileTypeToBinary() if binary else out.SetFileTypeToASCII()
    out.SetHeader("made for a test")
    out.SetFileName(str(path))
    out.Write()
    return path


@pytest.mark.parametrize("version", [42, 51])
@pytest.mark.parametrize("binary", [False, True])
def test_legacy_files_of_vtk_hold_what_vtk_was_given(version: int, binary: bool, tmp_path: Path) -> None:
    lines = read(write_legacy(polylines(LINES), tmp_path / "lines.vtk", version=version, binary=binary))
    for found, line in zip(lines.lines, LINES, strict=True):
        np.testing.assert_allclose(found, line, rtol=1e-5, atol=1e-5)
    mesh = grid()
    path = write_legacy(mesh, tmp_path / "grid.vtk", version=version, binary=binary)
    whole = read_legacy_vtk(path.read_bytes(), "grid")
    assert (whole.title, sorted(whole.point_data), sorted(whole.cell_data)) == (
        "made for a test",
        ["load"],
        ["fibres", "tissue"],
    )
    np.testing.assert_array_equal(whole.cell_data["tissue"][:, 0], mesh.cell_data["tissue"])
    np.testing.assert_allclose(whole.point_data["load"], mesh.point_data["load"], rtol=1e-5)
    field = read(path)
    vectors = mesh.cell_data["fibres"]
    np.testing.assert_allclose(field.places, mesh.cell_centers().points, atol=1e-6)
    np.testing.assert_allclose(
        field.directions, vectors / np.linalg.norm(vectors, axis=1)[:, None], rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize("ending", [".vtp", ".vtu"])
def test_xml_files_too(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{ending}"
    (polylines(LINES) if ending == ".vtp" else grid()).save(path)
    found = read(path)
    assert [len(line) for line in found.lines] == ([4, 5, 6] if ending == ".vtp" else [])
    assert len(found.places) == (0 if ending == ".vtp" else 8)
    if ending == ".vtu":
        vectors = grid().point_data["load"].astype(np.float64)
        at_points = read(path, array="load")
        np.testing.assert_array_equal(at_points.places, grid().points)
        np.testing.assert_allclose(at_points.directions, vectors / np.linalg.norm(vectors, axis=1)[:, None], atol=1e-12)


@pytest.mark.parametrize("ending", [".tck", ".trk"])
def test_tractograms_are_in_ras_and_mm(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"biceps{ending}"
    save(Tractogram([line.astype(np.float32) for line in LINES], affine_to_rasmm=np.eye(4)), str(path))
    for frame, turn in ((UNKNOWN, 1.0), ("patient (RAS), mm", 1.0), ("patient (LPS), mm", FLIP)):
        found = read(path, frame)
        assert found.muscle == "biceps"
        for own, line in zip(found.lines, LINES, strict=True):
            np.testing.assert_allclose(own, line * turn, rtol=0.0, atol=1e-4)
    _, notes = read_given_fibres(FibreFiles(path), anatomy_frame=UNKNOWN, muscles=[])
    assert "is in RAS, the anatomy's frame is 'as in the files'; they are taken to be one" in notes[0]
    with pytest.raises(InputError, match="are in RAS and mm; leave frame and units out"):
        read(path, units=Unit.METRE)
    cut = tmp_path / f"cut{ending}"
    cut.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match="cannot be read as a tractogram"):
        read(cut)


def test_a_tractogram_that_holds_fewer_lines_than_it_states_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.tck"
    save(Tractogram([line.astype(np.float32) for line in LINES], affine_to_rasmm=np.eye(4)), str(path))
    path.write_bytes(path.read_bytes().replace(b"count: 0000000003", b"count: 0000000005"))
    with pytest.raises(InputError, match="states 5 streamlines and holds 3"):
        read(path)


def test_frame_and_unit_of_a_vtk_file_are_its_titles_or_the_users(tmp_path: Path) -> None:
    path = tmp_path / "a.vtk"
    path.write_bytes(vtk_lines([LINES[0]], title="3D Slicer output. SPACE=RAS", line_data={}))
    np.testing.assert_allclose(read(path, "patient (LPS), mm").lines[0], LINES[0] * FLIP)
    with pytest.raises(InputError, match=r"its title says (ras|RAS), but (lps|LPS) was given"):
        read(path, frame=Frame.LPS)
    path.write_bytes(vtk_lines([LINES[0]], title="lines", line_data={"muscle": np.zeros(1)}))
    np.testing.assert_allclose(read(path, "patient (LPS), mm").lines[0], LINES[0])
    np.testing.assert_allclose(
        read(path, "patient (LPS), mm", frame=Frame.RAS, units=Unit.CENTIMETRE).lines[0], LINES[0] * 10.0 * FLIP
    )


def test_what_is_left_out_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.vtk"
    path.write_bytes(vtk_lines([LINES[0], LINES[1][:1]], title="lines", line_data={}))
    (found,), notes = read_given_fibres(FibreFiles(path), anatomy_frame=UNKNOWN, muscles=[])
    assert len(found.lines) == 1
    assert notes == ("a.vtk: 1 streamlines of one place, or vectors of length 0, are left out",)


HEAD = "# vtk DataFile Version 3.0\nt\nASCII\nDATASET "
BODY = "POLYDATA\nPOINTS 2 float\n0 0 0 1 1 1\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nothing", "not a legacy VTK file"),
        (HEAD + "STRUCTURED_POINTS\n", "of STRUCTURED_POINTS; read are POLYDATA and UNSTRUCTURED_GRID"),
        (HEAD + "POLYDATA\nPOINTS 900000000000 float\n0 0 0\n", "are 2700000000000 numbers, of which 3 follow"),
        (HEAD + BODY + "LINES 1 3\n2 0 7\n", "its LINES use points 0 to 7 of 2"),
        (HEAD + BODY + "LINES 1 3\n3 0 1\n", "which are not 1 cells"),
        (HEAD + BODY + "LINES 1 3\n2 0 a\n", "hold a value that is not a number"),
        (HEAD + BODY + "POINT_DATA 3\nSCALARS a float\nLOOKUP_TABLE default\n1 2 3\n", "'a' has 3 rows for 2 points"),
        (HEAD + BODY + "POINT_DATA 2\nSCALARS a string\n", "of type 'string'"),
    ],
)
def test_damaged_legacy_files_are_refused(text: str, said: str) -> None:
    with pytest.raises(MeshError, match=said):
        read_legacy_vtk(text.encode(), "a.vtk")


def test_files_without_fibres_or_with_too_many_are_refused(tmp_path: Path) -> None:
    mesh = grid()
    mesh.cell_data["other"] = mesh.cell_data["fibres"]
    mesh.cell_data.remove("fibres")
    mesh.save(tmp_path / "two.vtu")
    with pytest.raises(InputError, match=r"does not say which of its arrays the fibres are; name one of other, load"):
        read(tmp_path / "two.vtu")
    with pytest.raises(InputError, match="has no array 'x', or two"):
        read(tmp_path / "two.vtu", array="x")
    bare = pv.PolyData(np.eye(3))
    bare.save(tmp_path / "bare.vtp")
    with pytest.raises(InputError, match="holds neither lines nor an array"):
        read(tmp_path / "bare.vtp")
    with pytest.raises(InputError, match=r"fibres are read from \.tck"):
        read(tmp_path / "a.csv")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no file of fibres"):
        read(tmp_path / "empty")
    with pytest.raises(InputError, match="found a reach of -1"):
        read(tmp_path / "two.vtu", reach_mm=-1.0)


def test_a_folder_is_all_its_files(tmp_path: Path) -> None:
    for name in ("biceps", "other"):
        polylines(LINES).save(tmp_path / f"{name}.vtp")
    found, _ = read_given_fibres(FibreFiles(tmp_path), anatomy_frame=UNKNOWN, muscles=["biceps"])
    assert [(one.name, one.muscle) for one in found] == [("biceps.vtp", "biceps"), ("other.vtp", "")]
