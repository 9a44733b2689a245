"""VTK XML files: read as VTK reads them in every encoding, written back with only the points changed, never trusted."""

from __future__ import annotations

import base64
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from vtkmodules.vtkIOCore import vtkLZ4DataCompressor, vtkLZMADataCompressor, vtkZLibDataCompressor
from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

from musclefit.errors import MeshError
from musclefit.geometry.surfaces.polygons import cut_polygons, cut_strips
from musclefit.io.anatomy import read_surface
from musclefit.io.formats.points import read_points
from musclefit.io.formats.vtk_xml import VtkFile, read_vtp
from musclefit.vocabulary import Unit

COMPRESSORS = {"none": None, "zlib": vtkZLibDataCompressor, "lz4": vtkLZ4DataCompressor, "lzma": vtkLZMADataCompressor}
MODES = {
    "ascii": lambda writer: writer.SetDataModeToAscii(),
    "binary": lambda writer: writer.SetDataModeToBinary(),
    "appended base64": lambda writer: (writer.SetDataModeToAppended(), writer.EncodeAppendedDataOn()),
    "appended raw": lambda writer: (writer.SetDataModeToAppended(), writer.EncodeAppendedDataOff()),
}


def _ball() -> pv.PolyData:
    ball = pv.Icosphere(radius=10.0, nsub=3, center=(100.0, 1 / 3, -5.0))  # large enough for several blocks
    ball.points = ball.points.astype(np.float64)
    ball.point_data["load"] = np.arange(ball.n_points, dtype=np.float32)
    ball.cell_data["number"] = np.arange(ball.n_cells)
    ball.field_data["note"] = ["words, <&> too"]
    return ball


def _grid() -> pv.UnstructuredGrid:
    points = np.random.default_rng(0).normal(size=(8, 3))
    grid = pv.UnstructuredGrid(
        {pv.CellType.TETRA: np.array([[0, 1, 2, 3]]), pv.CellType.HEXAHEDRON: np.arange(8)[None]}, points
    )
    grid.cell_data["tissue"] = np.array([7, 8])
    return grid


def _written(mesh, path: Path, mode: str, compressor: str, *, wide: bool, big: bool = False) -> Path:
    writer = vtkXMLPolyDataWriter() if isinstance(mesh, pv.PolyData) else vtkXMLUnstructuredGridWriter()
    writer.SetInputData(mesh)
    writer.SetFileName(str(path))
    writer.SetBlockSize(4096)
    (writer.SetHeaderTypeToUInt64 if wide else writer.SetHeaderTypeToUInt32)()
    (writer.SetByteOrderToBigEndian if big else writer.SetByteOrderToLittleEndian)()
    writer.SetCompressor(None if COMPRESSORS[compressor] is None else COMPRESSORS[compressor]())
    MODES[mode](writer)
    assert writer.Write() == 1
    return path


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("compressor", COMPRESSORS)
@pytest.mark.parametrize("mode", MODES)
def test_every_encoding_is_read_as_it_was_written_and_comes_back_moved(mode, compressor, wide, big, tmp_path):
    ball, grid = _ball(), _grid()
    vtp = _written(ball, tmp_path / "ball.vtp", mode, compressor, wide=wide, big=big)
    raw = read_surface(vtp)
    np.testing.assert_array_equal(raw.vertices, ball.points)
    np.testing.assert_array_equal(raw.faces, ball.regular_faces)
    vtu = _written(grid, tmp_path / "grid.vtu", mode, compressor, wide=wide, big=big)
    for path, mesh in ((vtp, ball), (vtu, grid)):
        read = read_points(path, units=Unit.CENTIMETRE)
        np.testing.assert_allclose(read.points, mesh.points * 10.0, rtol=1e-15)
        out = path.with_name(f"moved{path.suffix}")
        read.rewrite(read.points + np.array([10.0, 0.0, -20.0]), out)
        again = pv.read(out)
        np.testing.assert_allclose(again.points, mesh.points + np.array([1.0, 0.0, -2.0]), rtol=0, atol=1e-13)
        assert again.array_names == mesh.array_names
        for name in mesh.array_names:
            np.testing.assert_array_equal(again[name], mesh[name])
    cells = VtkFile(vtu.read_bytes(), "grid", kind="UnstructuredGrid")
    assert cells.cell_types().tolist() == [pv.CellType.TETRA, pv.CellType.HEXAHEDRON]
    assert cells.cells("Cells", count="NumberOfCells").sizes.tolist() == [4, 8]
    assert cells.cell_data("tissue").tolist() == [7, 8]


def test_without_point_data_and_with_strips_and_polygons(tmp_path):
    flat = pv.PolyData(np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0.0]]))
    flat.faces = [6, 3, 4, 5, 0, 1, 2]  # an L, begun at the corner from which a fan covers it
    flat.save(tmp_path / "l.vtp")
    text = (tmp_path / "l.vtp").read_bytes()
    assert b"<PointData" in text
    bare = text.replace(b"<PointData>", b"").replace(b"</PointData>", b"")
    for first in range(6):
        flat.faces = [6, *np.roll(np.arange(6), first)]
        flat.save(tmp_path / "l.vtp")
        raw = read_surface(tmp_path / "l.vtp")
        a, b, c = (raw.vertices[raw.faces[:, k]] for k in range(3))
        areas = np.cross(b - a, c - a)[:, 2] / 2
        assert areas.min() > 0, first
        assert areas.sum() == pytest.approx(3.0)
    (tmp_path / "bare.vtp").write_bytes(bare)
    assert len(read_surface(tmp_path / "bare.vtp").faces) == 4
    stripped = pv.Plane(i_resolution=3, j_resolution=3).triangulate().strip()
    assert stripped.n_strips
    stripped.save(tmp_path / "strips.vtp")
    raw = read_surface(tmp_path / "strips.vtp")
    a, b, c = (raw.vertices[raw.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    assert len(raw.faces) == 18
    assert (normals[:, 2] * normals[0, 2] > 0).all()


def test_strips_wind_as_their_first_triangle_and_turn_by_a_doubled_corner():
    faces = cut_strips(np.array([5, 4]), np.array([0, 1, 2, 3, 4, 7, 8, 8, 9]))
    assert faces.tolist() == [[0, 1, 2], [1, 3, 2], [2, 3, 4]]


@pytest.mark.parametrize("seed", range(20))
def test_a_star_shaped_polygon_is_cut_without_folds_whatever_corner_is_first(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 30))
    angles = np.sort([*rng.uniform(0, 2 * np.pi, n - 3).tolist(), 0.1, 2.2, 4.3])
    flat = np.stack([np.cos(angles), np.sin(angles)], axis=1) * rng.uniform(0.3, 1.0, n)[:, None]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = np.c_[flat, np.zeros(n)] @ turn.T * 1e3 + rng.normal(size=3) * 1e4
    around = np.roll(np.arange(n), int(rng.integers(n)))
    faces = cut_polygons(points, np.array([n]), around)
    a, b, c = (points[faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a) @ np.cross(turn[:, 0], turn[:, 1]) / 2
    x, y = flat[around].T * 1e3
    whole = 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    assert areas.min() > -1e-6 * whole
    assert areas.sum() == pytest.approx(whole, rel=1e-9)


def test_a_bomb_is_refused_before_it_goes_off(tmp_path):
    """A block that says how large it is, or is larger than it says."""
    ball = _written(_ball(), tmp_path / "ball.vtp", "binary", "zlib", wide=False).read_bytes()
    begin = ball.index(b"<Points>")
    begin = ball.index(b">", begin + 8) + 1
    end = ball.index(b"<", begin)
    for stated in (100_000_000, 7740):
        packed = zlib.compress(bytes(100_000_000), 9)
        header = struct.pack("<4I", 1, stated, 0, len(packed))
        swollen = ball[:begin] + base64.b64encode(header) + base64.b64encode(packed) + ball[end:]
        with pytest.raises(MeshError, match="as a VTK XML file it is damaged"):
            read_vtp(swollen, "a.vtp")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b"PolyData", b"Polydata", "of type 'Polydata'; expected PolyData"),
        (b'<?xml version="1.0"?>', b'<!DOCTYPE a [<!ENTITY b "c">]>', "has a document type"),
        (b'format="ascii"', b'format="appended" offset="3"', "of which it has none"),
        (b'format="ascii"', b'format="octal"', "are written as 'octal'"),
        (b'type="Float64"', b'type="Complex"', "are of type 'Complex'"),
        (b"</VTKFile>", b"", "its last tag </VTKFile> is missing"),
        (b'Polys="320"', b'Polys="99999999999999999"', "states 99999999999999999 Polys"),
        (b'Polys="320"', b'Polys="-1"', "not a count"),
    ],
)
def test_what_does_not_fit_is_named(old, new, said, tmp_path):
    data = _written(pv.Icosphere(nsub=2), tmp_path / "a.vtp", "ascii", "none", wide=False).read_bytes()
    data = data.replace(b'type="Float32"', b'type="Float64"')
    assert old in data
    with pytest.raises(MeshError, match=said):
        read_vtp(data.replace(old, new), "a.vtp")
