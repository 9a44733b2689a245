"""Quality tables of a run's tetrahedra against VTK's own measures, before and after."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from tet_blocks import two_tissues

from musclefit.cli import main
from musclefit.io.run_folder import DeformedTets, labelled_tets


def written(folder: Path, *, noise: float) -> None:
    folder.mkdir()
    rest = two_tissues((4, 3, 3))
    moved = rest.mesh.vertices + noise * np.random.default_rng(2).uniform(-1.0, 1.0, rest.mesh.vertices.shape)
    labelled_tets(DeformedTets(rest, moved)).save(folder / "tets.vtu")
    (folder / "report.json").write_text(json.dumps({"title": "Two tissues"}), encoding="utf-8")


def test_the_table_is_that_of_vtk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written(tmp_path / "run", noise=0.15)
    out = tmp_path / "quality.csv"
    assert main(["check-mesh", str(tmp_path / "run"), "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    with out.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["tissue"], row["shape"]) for row in rows] == [
        (tissue, shape) for tissue in ("all tissues", "muscle", "bone") for shape in ("rest", "deformed")
    ]
    assert [float(row["scaled_jacobian_min"]) for row in rows] == [q["scaled_jacobian_min"] for q in told["quality"]]
    grid = pv.read(tmp_path / "run" / "tets.vtu")
    moved = grid.points.copy()
    for shape, points in (("rest", grid.point_data["rest_position_mm"]), ("deformed", moved)):
        grid.points = points
        by_vtk = grid.cell_quality(["scaled_jacobian", "min_angle"])
        jacobians, angles = by_vtk.cell_data["scaled_jacobian"], by_vtk.cell_data["min_angle"]
        (row,) = (row for row in rows if (row["tissue"], row["shape"]) == ("all tissues", shape))
        assert float(row["scaled_jacobian_min"]) == pytest.approx(jacobians.min(), rel=1e-6)
        assert float(row["scaled_jacobian_mean"]) == pytest.approx(jacobians.mean(), rel=1e-6)
        assert float(row["dihedral_min_deg"]) == pytest.approx(angles.min(), rel=1e-5)
        assert int(row["tets"]) == grid.n_cells


def test_a_tetrahedron_inside_out_is_counted_and_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written(tmp_path / "run", noise=0.9)
    assert main(["check-mesh", str(tmp_path / "run")]) == 1
    first = capsys.readouterr().out.splitlines()[0]
    assert "inside out 0 and " in first
    assert not first.endswith("and 0")


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check-mesh", str(tmp_path)]) == 2
    assert "name the folder that a run wrote" in capsys.readouterr().err
    written(tmp_path / "run", noise=0.0)
    assert main(["check-mesh", str(tmp_path / "run"), "--out", str(tmp_path)]) == 2
