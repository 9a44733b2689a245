"""Attached points: every format comes back moved, with the rest of the file kept; slips are named."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from tiny_rigs import egg, write_tiny_rig

from musclefit.cli import main
from musclefit.errors import InputError
from musclefit.io.anatomy import read_surface
from musclefit.io.formats.points import read_points
from musclefit.io.rigs import read_rig
from musclefit.io.run_folder import ply_bytes
from musclefit.pipeline.retarget import retarget
from musclefit.vocabulary import Unit

SHIFT = np.array([1.0, -20.0, 300.0])
FCSV = (
    "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n"
    "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    '1,1,2,3,0,0,0,1,1,1,0,elbow,"a, b",\n2,-4.5,50,6,0,0,0,1,1,1,0,wrist,,\n'
)
MARKUPS = {
    "markups": [
        {
            "type": "Fiducial",
            "coordinateSystem": "LPS",
            "coordinateUnits": "cm",
            "controlPoints": [
                {"label": "a", "position": [0.1, 0.2, 0.3], "locked": True},
                {"label": "b", "position": [5.0, 0.0, 0.5]},
            ],
        }
    ]
}


def write_all(folder: Path) -> list[Path]:
    """One file of each format."""
    ball = egg((0.0, 0.0, 0.0), (5.0, 4.0, 3.0), subdivisions=1)
    (folder / "a.csv").write_text("muscle;x_cm;y_cm;z_cm;note\nbiceps;1;2;3;first\nbiceps;4;5;6;second\n")
    (folder / "b.fcsv").write_text(FCSV)
    (folder / "c.mrk.json").write_text(json.dumps(MARKUPS))
    (folder / "d.ply").write_bytes(ply_bytes(ball))
    lines = [f"v {x} {y} {z}" for x, y, z in ball.vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in ball.faces]
    (folder / "e.obj").write_text("# a comment\ng ball\n" + "\n".join(lines) + "\n")
    mesh = pv.PolyData.from_regular_faces(np.array(ball.vertices), np.array(ball.faces))
    mesh.save(folder / "f.stl")
    mesh["load"] = np.arange(len(ball.vertices), dtype=float)
    mesh.save(folder / "g.vtp")
    grid = pv.UnstructuredGrid({pv.CellType.TETRA: np.array([[0, 1, 2, 3]])}, np.eye(4)[:, :3])
    grid.cell_data["tissue"] = np.array([7])
    grid.save(folder / "h.vtu")
    return sorted(folder.iterdir())


def test_every_format_comes_back_moved(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    for path in write_all(tmp_path / "in"):
        read = read_points(path, units=Unit.MILLIMETRE)
        out = tmp_path / "out" / path.name
        read.rewrite(read.points + SHIFT, out)
        again = read_points(out, units=Unit.MILLIMETRE)
        tolerance = 1e-4 if path.suffix == ".stl" else 1e-9
        np.testing.assert_allclose(again.points, read.points + SHIFT, rtol=0, atol=tolerance, err_msg=path.name)
    out = tmp_path / "out"
    rows = list(csv.DictReader((out / "a.csv").read_text().splitlines(), delimiter=";"))
    assert [row["note"] for row in rows] == ["first", "second"]
    assert float(rows[0]["z_cm"]) == pytest.approx(33.0)
    assert '"a, b"' in (out / "b.fcsv").read_text()
    assert json.loads((out / "c.mrk.json").read_text())["markups"][0]["controlPoints"][0]["locked"] is True
    assert (out / "e.obj").read_text().startswith("# a comment\ng ball\nv ")
    np.testing.assert_array_equal(pv.read(out / "g.vtp")["load"], np.arange(42.0))
    assert pv.read(out / "h.vtu").cell_data["tissue"].tolist() == [7]
    np.testing.assert_array_equal(read_surface(out / "d.ply").faces, read_surface(tmp_path / "in" / "d.ply").faces)


def test_points_in_metres_stay_in_metres(tmp_path: Path) -> None:
    ball = egg((0.0, 0.0, 0.0), (0.5, 0.4, 0.3), subdivisions=1)
    (tmp_path / "m.ply").write_bytes(ply_bytes(ball))
    read = read_points(tmp_path / "m.ply", units=Unit.METRE)
    assert np.abs(read.points).max() == pytest.approx(500.0)
    read.rewrite(read.points + SHIFT, tmp_path / "out.ply")
    moved = read_surface(tmp_path / "out.ply").vertices
    np.testing.assert_allclose(moved, ball.vertices + SHIFT / 1000.0, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.txt", "1 2 3", "points are read from .csv, .fcsv"),
        ("a.csv", "name,u,v,w\na,1,2,3\n", "no columns x_mm, y_mm, z_mm"),
        ("a.csv", "x_mm,y_mm,z_mm\n", "has no point"),
        ("a.csv", "x_mm,y_mm,z_mm\n1,2,x\n", "line 2: z_mm is 'x', which is not a number"),
        ("a.csv", "", "an empty file"),
        ("a.mrk.json", "{", "broken JSON"),
    ],
)
def test_slips_are_named(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=said):
        read_points(tmp_path / name, units=Unit.MILLIMETRE)


def test_a_run_takes_points_where_its_map_takes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = write_tiny_rig(tmp_path)
    (tmp_path / "path.csv").write_text("x_mm,y_mm,z_mm\n1,2,3\n9999,0,0\n")
    out = tmp_path / "out"
    code = main(
        ["run", str(rig), "--out", str(out), "--points", str(tmp_path / "path.csv"), "--no-tets", "--no-pictures"]
    )
    assert code in (0, 1)
    told = " ".join(capsys.readouterr().err.split())
    assert "path.csv: 1 of 2 points are outside the skin, up to 9.94e+03 mm from it (point 2)" in told
    job = read_rig(rig, points=[tmp_path / "path.csv"])
    moved = retarget(job, tets=None).result.deformation(np.array([[1.0, 2.0, 3.0], [9999.0, 0.0, 0.0]]))
    written = read_points(out / "points" / "path.csv", units=Unit.MILLIMETRE).points
    np.testing.assert_allclose(written, moved, rtol=0, atol=1e-9)
    report = json.loads((out / "report.json").read_text())
    assert "points/path.csv" in report["files"]
    assert "path.csv" in " ".join(report["provenance"]["input_sha256"])


def test_two_files_of_one_name_are_refused(tmp_path: Path) -> None:
    rig = write_tiny_rig(tmp_path)
    (tmp_path / "other").mkdir()
    for folder in (tmp_path, tmp_path / "other"):
        (folder / "p.csv").write_text("x_mm,y_mm,z_mm\n1,2,3\n")
    with pytest.raises(InputError, match=r"anatomy.points: .*two files of points are named 'p.csv'"):
        read_rig(rig, points=[tmp_path / "p.csv", tmp_path / "other" / "p.csv"])
