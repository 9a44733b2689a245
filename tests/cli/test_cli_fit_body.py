"""`musclefit fit-body`: scans of other triangles, noisy, holed, elsewhere; the rig it writes runs, certified."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from scans import LIMBS, PLACE, SHIFT, mannequin, scan, with_floor
from scipy.spatial.transform import Rotation
from tiny_rigs import egg

import musclefit as mf
from musclefit.cli.commands import main
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.io.run_folder import ply_bytes
from musclefit.vocabulary import Claim

VERTICES = ("--vertices", "150")


def saved(path: Path, mesh: TriMesh, *, scale: float = 1.0) -> Path:
    path.write_bytes(ply_bytes(mesh.with_vertices(scale * mesh.vertices)))
    return path


@pytest.fixture(scope="module")
def skin(tmp_path_factory) -> Path:
    return saved(tmp_path_factory.mktemp("template") / "skin.ply", mannequin(voxel_mm=13.0))


SCANS = {
    "decimated": lambda: scan(voxel_mm=17.0, seed=1),
    "holed, noisy and elsewhere": lambda: scan(noise_mm=0.7, holes=4, moved=True, seed=2),
    "inside out": lambda: TriMesh(scan(seed=3).vertices, scan(seed=3).faces[:, ::-1]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCANS)
def test_the_skin_lies_on_the_scan_and_on_the_body_behind_its_holes(skin, tmp_path, name):
    fitted = mf.fit_body(skin, saved(tmp_path / "scan.ply", SCANS[name]()), vertices=150)
    assert fitted.passed
    fit = fitted.fit
    assert fit.from_scan.median_mm < 1.0
    assert fit.from_scan.most_95_mm < 4.0
    assert fit.turned == (name == "inside out")
    assert fit.unmatched < 0.02
    assert (fit.uncovered > 0.02) == ("holed" in name)
    assert fit.rival is None or fit.rival > 1.5
    # Against the body itself, which the fit never saw: whole, without noise, in the scan's place.
    body = scan(voxel_mm=7.0, moved="elsewhere" in name)
    distances = nearest_places(fit.motion(fit.skin.vertices), body).distances
    assert np.median(distances) < 1.0
    assert np.percentile(distances, 95) < 4.0
    # Heads go to heads and hands to hands, front to front: only there is that much of the body near.
    raised = Rotation.from_euler("y", -14.0, degrees=True)
    shoulder, hand = (np.array(end, dtype=float) for end in LIMBS["left arm"][:2])
    for place, there in (
        (hand, shoulder + raised.apply(hand - shoulder)),
        *((LIMBS[k][1],) * 2 for k in ("nose", "left foot")),
    ):
        goes = fit.motion(fit.deformation(np.array([place], dtype=float)))[0]
        there = PLACE @ np.array(there, dtype=float) + SHIFT if "elsewhere" in name else there
        assert np.linalg.norm(goes - there) < 25.0


def test_the_folder_holds_a_rig_that_runs_certified_and_carries_what_is_inside(skin, tmp_path, capsys):
    bone = egg((0, 0, 20), (15, 15, 60))
    (tmp_path / "bones").mkdir()
    saved(tmp_path / "bones" / "femur.ply", bone)
    given = saved(tmp_path / "scan.ply", scan(voxel_mm=12.0, holes=2, moved=True, seed=5), scale=0.001)
    out = tmp_path / "fit"
    pattern = str(tmp_path / "bones" / "*.ply")
    arguments = ["--scan-units", "m", "--anatomy", pattern, "--frame", "LPS", *VERTICES]
    assert main(["fit-body", str(skin), str(given), str(out), *arguments]) == 0
    said = capsys.readouterr().out
    assert "passed; the scan is" in said
    assert f"next: musclefit run {out / 'body.toml'}" in said
    assert sorted(path.name for path in out.iterdir()) == [
        "body.toml",
        "cage.ply",
        "cage_target.ply",
        "fit.json",
        "scan.vtp",
        "skin_fitted.vtp",
    ]
    done = mf.run(out / "body.toml", tets=False)
    assert done.report.result.map.claim is Claim.CERTIFIED
    assert sorted(t.name for t in done.rest) == ["femur", "skin"]
    fitted = pv.read(out / "skin_fitted.vtp")
    np.testing.assert_allclose(done.deformation(mannequin(voxel_mm=13.0).vertices), fitted.points, rtol=0, atol=1e-4)
    report = json.loads((out / "fit.json").read_text())
    matrix = np.array(report["template_to_scan"])
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.degrees(np.arccos((np.trace(matrix[:3, :3].T @ PLACE) - 1) / 2)) < 6.0
    assert np.linalg.norm(matrix[:3, 3] - SHIFT) < 30.0
    scanned = pv.read(out / "scan.vtp")
    assert np.percentile(scanned["distance_mm"], 95) < 5.0
    assert 0.0 < 1.0 - fitted["covered"].mean() < 0.2
    # Against the body itself, which the fit never saw: whole, in the scan's place.
    there = fitted.points @ matrix[:3, :3].T + matrix[:3, 3]
    distances = nearest_places(np.asarray(there, dtype=float), scan(voxel_mm=7.0, moved=True)).distances
    assert np.median(distances) < 1.0
    assert np.percentile(distances, 95) < 4.0


@pytest.mark.slow
def test_what_is_no_body_fails_is_told_and_pulls_at_nothing(skin, tmp_path, capsys):
    given = saved(tmp_path / "scan.ply", with_floor(scan(seed=6)))
    code = main(["fit-body", str(skin), str(given), str(tmp_path / "fit"), *VERTICES])
    out = capsys.readouterr().out
    assert code == 1
    assert "FAILED: colour" in out
    assert json.loads((tmp_path / "fit" / "fit.json").read_text())["scan_unmatched_percent"] > 10.0
    matrix = np.array(json.loads((tmp_path / "fit" / "fit.json").read_text())["template_to_scan"])
    there = pv.read(tmp_path / "fit" / "skin_fitted.vtp").points @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.percentile(nearest_places(np.asarray(there, dtype=float), scan(seed=6)).distances, 90) < 4.0


def test_landmarks_lay_a_scan_that_could_lie_either_way(tmp_path):
    """An ellipsoid has no front: three landmarks say how it lies."""
    body = egg((0, 0, 0), (120, 60, 50), subdivisions=4)
    skin = saved(tmp_path / "skin.ply", body)
    turn = np.diag([-1.0, -1.0, 1.0])
    given = saved(tmp_path / "scan.ply", TriMesh(body.vertices @ turn.T, body.faces))
    places = {"head": (120, 0, 0), "left": (0, 60, 0), "front": (0, 0, 50)}
    for name, motion in (("template", np.eye(3)), ("scan", turn)):
        rows = [f"{key},{','.join(str(float(x)) for x in motion @ at)}" for key, at in places.items()]
        (tmp_path / f"{name}.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows]) + "\n")
    marks = (tmp_path / "template.csv", tmp_path / "scan.csv")
    fit = mf.fit_body(skin, given, vertices=60, landmarks=marks).fit
    np.testing.assert_allclose(fit.motion.rotation, turn, atol=1e-6)
    np.testing.assert_allclose(fit.motion(fit.skin.vertices), body.vertices @ turn.T, atol=1.0)


@pytest.mark.parametrize("frame", [pytest.param("RAS", marks=pytest.mark.slow), "scanner (RAS), mm"])
def test_landmarks_are_taken_in_the_frame_of_their_template_and_told_where_they_lie_off_it(tmp_path, frame):
    body = egg((200, 0, 0), (120, 60, 50), subdivisions=3)
    skin = saved(tmp_path / "skin.ply", body)
    places = {
        "head": (120.0, 0.0, 0.0),
        "left": (200.0, 60.0, 0.0),
        "front": (200.0, 0.0, 50.0),
        "hip": (130.0, 40.0, 20.0),
    }
    for name, sign, system in (("ras", 1.0, "RAS"), ("lps", -1.0, "LPS")):
        points = [
            {"label": key, "position": [sign * x, sign * y, z], "positionStatus": "defined"}
            for key, (x, y, z) in places.items()
        ]
        markups = [{"type": "Fiducial", "coordinateSystem": system, "coordinateUnits": "mm", "controlPoints": points}]
        (tmp_path / f"{name}.mrk.json").write_text(json.dumps({"markups": markups}))
    ras, lps = tmp_path / "ras.mrk.json", tmp_path / "lps.mrk.json"
    right = mf.fit_body(skin, skin, vertices=60, landmarks=(lps, ras), frame=frame)
    np.testing.assert_allclose(right.fit.motion.rotation, np.eye(3), atol=1e-6)
    assert [found.code for found in right.findings] == []
    wrong = mf.fit_body(skin, skin, vertices=60, landmarks=(lps, lps), frame=frame)
    off = [found for found in wrong.findings if found.code == "landmarks-off-surface"]
    assert len(off) == 1
    assert "if x and y had the other sign, as RAS has against LPS" in off[0].message


def test_what_cannot_be_fitted_is_refused_and_nothing_is_written(skin, tmp_path, capsys):
    good = saved(tmp_path / "scan.ply", scan(voxel_mm=20.0))
    huge = saved(tmp_path / "huge.ply", scan(voxel_mm=20.0), scale=1000.0)
    opened = saved(tmp_path / "open.ply", scan(voxel_mm=20.0, holes=1))
    points = tmp_path / "points.ply"
    points.write_bytes(ply_bytes(TriMesh(np.eye(3), np.zeros((0, 3), dtype=np.int64))))
    flat = saved(tmp_path / "flat.ply", TriMesh(np.zeros((3, 3)), np.array([[0, 1, 2]])))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("")
    (tmp_path / "line.csv").write_text("name,x_mm,y_mm,z_mm\na,0,0,0\nb,50,0,0\nc,100,0,0\n")
    line = str(tmp_path / "line.csv")
    out = tmp_path / "fit"
    before = sorted(tmp_path.rglob("*"))
    for template_, scan_, folder, more, message in (
        (skin, tmp_path / "none.ply", out, (), "cannot be read"),
        (opened, good, out, (), "open"),
        (skin, points, out, (), ""),
        (skin, flat, out, (), "has an area"),
        (skin, huge, out, VERTICES, "likely wrong units"),
        (skin, good, tmp_path / "full", (), "is not an empty folder"),
        (skin, good, out, ("--vertices", "5"), "vertices"),
        (skin, good, out, ("--median-mm", "0"), "expected a length above 0"),
        (skin, good, out, ("--template-landmarks", line), "come in two files"),
        (skin, good, out, ("--template-landmarks", line, "--scan-landmarks", line, *VERTICES), "lie on a line"),
    ):
        assert main(["fit-body", str(template_), str(scan_), str(folder), "--quiet", *more]) == 2, message
        assert message in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before
