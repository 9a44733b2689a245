"""The repair command: what it writes, what it says, and when it writes nothing."""

from __future__ import annotations

import json

import numpy as np
import pytest
from planted import ball, box, joined, moebius

from musclefit.anatomy.repair.records import RepairSettings
from musclefit.cli import main
from musclefit.cli.repair import CLEARANCE_MM
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.faults import faults_of
from musclefit.io.anatomy import read_anatomy, read_surface
from musclefit.io.run_folder import ply_bytes


def _write(path, mesh):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(ply_bytes(mesh))
    return path


def _holed():
    mesh = ball()
    return TriMesh(mesh.vertices, mesh.faces[1:])


def test_a_folder_is_repaired_with_a_report_of_every_change(tmp_path, capsys):
    folder = tmp_path / "in"
    _write(folder / "bone_a.ply", _holed())
    clean = _write(folder / "muscle_b.ply", ball(at=(40.0, 0.0, 0.0)))
    assert main(["repair", str(folder), str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "PASSED" in said
    assert "filled a hole of 3 edges" in said
    assert "1 of them left as they are" in said
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] == "passed"
    first, second = report["surfaces"]
    assert (first["name"], first["way"], first["faults_before"]) == ("bone_a", "local", {"boundary_edges": 3})
    assert [change["code"] for change in first["changes"]] == ["filled-holes"]
    assert first["distance"]["from_original_mm"] <= 1e-9
    assert (second["way"], second["changes"], second["faults_before"]) == ("untouched", [], {})
    assert (tmp_path / "out" / "muscle_b.ply").read_bytes() == clean.read_bytes()
    assert faults_of(read_surface(tmp_path / "out" / "bone_a.ply").mesh()).none


def test_one_file_is_repaired_into_one_file_with_a_report_beside_it(tmp_path, capsys):
    given = _write(tmp_path / "femur.ply", _holed())
    assert main(["repair", str(given), str(tmp_path / "mended.ply")]) == 0
    assert faults_of(read_surface(tmp_path / "mended.ply").mesh()).none
    assert json.loads((tmp_path / "mended.repair.json").read_text())["surfaces"][0]["name"] == "femur"
    capsys.readouterr()
    assert main(["repair", str(given), str(tmp_path / "mended.ply"), "--json"]) == 0  # its own file may be replaced
    assert json.loads(capsys.readouterr().out)["surfaces"][0]["faults_after"] == {}


def test_overlaps_are_resolved_and_reported_by_pair(tmp_path, capsys):
    folder = tmp_path / "in"
    _write(folder / "bones" / "b.ply", box((4.0, 4.0, 4.0)))
    _write(folder / "muscles" / "m.ply", box((6.0, 2.0, 2.0), at=(3.0, 1.0, 1.0)))
    options = ["--resolve", "priority", "--max-change-percent", "20"]  # a fifth of the muscle is in the bone
    assert main(["repair", str(folder), str(tmp_path / "out"), *options]) == 0
    said = capsys.readouterr().out
    assert "1 overlapping pairs, 4 mm³ in all, 0 left" in said
    assert "b / m: priority: bone before muscle" in said
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    (pair,) = report["overlaps_resolved"]
    assert pair == {
        "a": "b",
        "b": "m",
        "rule": "priority: bone before muscle",
        "overlap_mm3": pytest.approx(4.0),
        "from_a_mm3": 0.0,
        "from_b_mm3": pytest.approx(4.0),
    }
    assert report["cuts"][0]["name"] == "m"
    assert (report["rule"], report["choice"], report["clearance_mm"]) == ("priority", "least-loss", 0.1)
    assert report["pairs_below_clearance"] == report["tissues_with_thin_places"] == []
    assert "clearance of 0.1 mm kept between all tissues" in said
    anatomy = read_anatomy(tmp_path / "out").anatomy
    assert [(t.name, t.kind.value) for t in anatomy] == [("m", "muscle"), ("b", "bone")]


def _overlapping(folder):
    _write(folder / "bones" / "b.ply", box((4.0, 4.0, 4.0)))
    _write(folder / "muscles" / "m.ply", box((6.0, 2.0, 2.0), at=(3.0, 1.0, 1.0)))
    return folder


def test_a_tissue_that_loses_much_gives_1_and_is_named_with_all_written(tmp_path, capsys):
    folder, out = _overlapping(tmp_path / "in"), tmp_path / "out"
    assert main(["repair", str(folder), str(out), "--resolve", "priority"]) == 1
    said = capsys.readouterr().out
    assert "failed: change of volume 18.75 %, limit 5 (m: 24 to 19.5 mm³, -18.8 %; 1 to 1 pieces)" in said
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == "failed"
    lost = {one["name"]: one["change_percent"] for one in report["tissues"]}
    assert lost == {"b": 0.0, "m": pytest.approx(-18.75, abs=0.01)}
    assert sorted(path.relative_to(out).as_posix() for path in out.rglob("*.ply")) == ["bones/b.ply", "muscles/m.ply"]


def test_a_tissue_that_falls_apart_gives_1_whatever_it_loses(tmp_path, capsys):
    folder = tmp_path / "in"
    _write(folder / "muscle_bar.ply", box((2.0, 2.0, 40.0)))
    _write(folder / "bone_plate.ply", box((8.0, 8.0, 1.0), at=(-3.0, -3.0, 20.0)))
    assert main(["repair", str(folder), str(tmp_path / "out"), "--resolve", "priority"]) == 1
    said = capsys.readouterr().out
    assert "failed: pieces 2 , limit 1 (muscle_bar: 160 to 155 mm³, -3.1 %; 1 to 2 pieces)" in said
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    (cut,) = report["cuts"]
    assert (cut["pieces_before"], cut["pieces_after"]) == (1, 2)


def test_a_repair_that_changes_a_volume_much_gives_1_without_overlaps_too(tmp_path, capsys):
    mesh = ball()
    faces = mesh.faces.copy()
    upper = mesh.vertices[faces].mean(axis=1)[:, 2] > 4.0
    faces[upper] = faces[upper][:, ::-1]
    given = _write(tmp_path / "radius.ply", TriMesh(mesh.vertices, faces))
    assert main(["repair", str(given), str(tmp_path / "out.ply")]) == 1
    said = capsys.readouterr().out
    assert "failed: change of volume" in said
    (tissue,) = json.loads((tmp_path / "out.repair.json").read_text())["tissues"]
    assert tissue["change_percent"] > 50.0
    assert tissue["volume_after_mm3"] == pytest.approx(enclosed_volume(mesh), rel=1e-9)
    assert main(["repair", str(given), str(tmp_path / "out.ply"), "--max-change-percent", "900", "--quiet"]) == 0


def test_the_next_run_knows_the_report_that_a_repair_left(tmp_path, capsys):
    folder, out = _overlapping(tmp_path / "in"), tmp_path / "out"
    main(["repair", str(folder), str(out), "--resolve", "priority", "--quiet"])
    assert [finding.code for finding in read_anatomy(out).findings] == []
    assert main(["repair", str(out), str(tmp_path / "again"), "--resolve", "priority"]) == 0
    assert "not read" not in capsys.readouterr().out
    (out / "other.json").write_text("{}")
    (finding,) = read_anatomy(out).findings
    assert "1 files and folders were not read: other.json" in finding.message


def test_clearance_and_rule_are_options_and_told(tmp_path, capsys):
    folder = tmp_path / "in"
    _write(folder / "muscle_a.ply", box((10.0, 10.0, 10.0)))
    _write(folder / "muscle_b.ply", box((9.0, 9.0, 9.0), at=(0.5, 0.5, 9.9)))
    options = ["--resolve", "priority", "--clearance-mm", "0.2", "--rule", "smaller"]
    assert main(["repair", str(folder), str(tmp_path / "out"), *options]) == 0
    said = capsys.readouterr().out
    assert "clearance of 0.2 mm kept between all tissues" in said
    assert "muscle_b / muscle_a: priority: the smaller muscle" in said
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["choice"], report["clearance_mm"]) == ("smaller", 0.2)
    assert main(["repair", str(folder), str(tmp_path / "no"), *options[:3], "5"]) == 2
    assert "clearance_mm is 5.0; expected at most 2" in capsys.readouterr().err
    assert main(["repair", str(folder), str(tmp_path / "no"), "--rule", "smaller"]) == 2
    assert "add --resolve priority or split" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


def test_the_clearance_of_the_command_is_that_of_the_settings():
    assert RepairSettings().clearance_mm == CLEARANCE_MM


def test_a_dry_run_writes_nothing(tmp_path, capsys):
    given = _write(tmp_path / "a.ply", _holed())
    assert main(["repair", str(given), str(tmp_path / "out"), "--dry-run"]) == 0
    assert "dry run: nothing was written" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply"]


def test_a_broken_limit_gives_1_and_is_written_and_said(tmp_path, capsys):
    mesh = ball()
    vertices = mesh.vertices.copy()
    vertices[7] *= -1.3
    given = _write(tmp_path / "a.ply", TriMesh(vertices, mesh.faces))
    out = tmp_path / "out"
    assert main(["repair", str(given), str(out), "--limit-mm", "0.001", "--local-only"]) == 1
    assert "failed: distance from the original" in capsys.readouterr().out
    assert json.loads((out / "report.json").read_text())["verdict"] == "failed"


REFUSED = {
    "one-sided": (lambda: TriMesh(*moebius()), "a one-sided surface"),
    "flat": (lambda: TriMesh(ball(1).vertices * [1.0, 1.0, 0.0], ball(1).faces), "no inside"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_has_no_inside_gives_2_and_nothing_is_written(tmp_path, capsys, what):
    mesh, message = REFUSED[what]
    folder = tmp_path / "in"
    _write(folder / "a.ply", mesh())
    _write(folder / "b.ply", ball())
    assert main(["repair", str(folder), str(tmp_path / "out"), "--local-only"]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        ("in", "in", "is, holds or lies in what is to be repaired"),
        ("in", "in/out", "is, holds or lies in what is to be repaired"),
        ("in/a.ply", "other.ply", "is there already, and no repair wrote it"),
        ("in", "taken", "is not empty and holds no report.json"),
        ("nothing", "out", "is not there"),
    ],
)
def test_targets_that_would_lose_something_are_refused(tmp_path, capsys, source, target, message):
    _write(tmp_path / "in" / "a.ply", _holed())
    (tmp_path / "other.ply").write_text("mine")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine.txt").write_text("mine")
    assert main(["repair", str(tmp_path / source), str(tmp_path / target)]) == 2
    assert message in capsys.readouterr().err
    assert (tmp_path / "other.ply").read_text() == "mine"
    assert not (tmp_path / "out").exists()


def test_positions_that_are_no_numbers_are_refused_by_file(tmp_path, capsys):
    vertices = np.array(ball().vertices)
    vertices[3, 1] = np.nan
    header, _, body = ply_bytes(ball()).partition(b"end_header\n")
    raw = vertices.astype("<f8").tobytes() + body[vertices.nbytes :]
    (tmp_path / "a.ply").write_bytes(header + b"end_header\n" + raw)
    assert main(["repair", str(tmp_path / "a.ply"), str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "a.ply: 1 vertices are not finite, the first is number 3" in said
    assert not (tmp_path / "out").exists()


def test_settings_are_checked(tmp_path, capsys):
    _write(tmp_path / "a.ply", _holed())
    assert main(["repair", str(tmp_path / "a.ply"), str(tmp_path / "out"), "--limit-mm", "-1"]) == 2
    assert "limit_mm is -1.0" in capsys.readouterr().err


def test_units_are_made_millimetres(tmp_path):
    mesh = ball()
    given = _write(tmp_path / "a.ply", TriMesh(mesh.vertices * 1e-3, mesh.faces))
    assert main(["repair", str(given), str(tmp_path / "b.ply"), "--units", "m"]) == 0
    np.testing.assert_allclose(read_surface(tmp_path / "b.ply").vertices, mesh.vertices, rtol=1e-12, atol=1e-12)


def test_crossing_blobs_in_one_file_become_one(tmp_path):
    given = _write(tmp_path / "a.ply", joined(ball(), ball(at=(12.0, 1.0, 0.5))))
    assert main(["repair", str(given), str(tmp_path / "b.ply"), "--quiet"]) == 0
    assert faults_of(read_surface(tmp_path / "b.ply").mesh()).none


@pytest.mark.slow
def test_a_tangled_bone_is_resurfaced_within_the_limit(tmp_path, anatomy_data):
    bone = anatomy_data / "opensim" / "rajagopal2016" / "Geometry" / "sacrum.vtp"
    assert main(["repair", str(bone), str(tmp_path / "b.ply"), "--units", "m", "--quiet"]) == 0
    (surface,) = json.loads((tmp_path / "b.repair.json").read_text())["surfaces"]
    assert surface["way"] == "resurfaced"
    assert surface["faults_after"] == {}
    assert max(surface["distance"]["from_original_mm"], surface["distance"]["to_original_mm"]) <= 0.3


@pytest.mark.parametrize("name", ["r_femur", "l_pelvis", "l_tibia", "metacarpal4_lvs", "metacarpal5_rvs"])
def test_bones_that_are_no_manifolds_become_solids(tmp_path, anatomy_data, name):
    bone = anatomy_data / "opensim" / "rajagopal2016" / "Geometry" / f"{name}.vtp"
    assert faults_of(read_surface(bone).mesh()).non_manifold_edges > 0
    options = ["--units", "m", "--quiet", "--local-only", "--max-change-percent", "6"]  # the tibia's doubled faces
    assert main(["repair", str(bone), str(tmp_path / "b.ply"), *options]) == 0
    assert faults_of(read_surface(tmp_path / "b.ply").mesh()).none
