"""The command for muscle architecture: tables and fibres of a tiny rig, at rest and carried; bad input refused."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import pyvista as pv
from scipy.spatial import cKDTree
from tiny_rigs import drive_by_joints, egg, write_tiny_rig

from musclefit.cli import main
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.geometry.surfaces.sections import Lengthwise
from musclefit.io.formats.vtk_lines import vtk_lines
from musclefit.io.run_folder import ply_bytes
from musclefit.muscles import attachments


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    made = write_tiny_rig(tmp_path / "rig")
    drive_by_joints(made)
    return made


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as text:
        return list(csv.DictReader(text))


def test_attachments_fibres_and_moment_arms_are_written(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["architecture", str(rig), "--out", str(out), "--within-mm", "8"]) == 0
    assert "fibres in 1 of 1 muscles, two attachments on bone in 1" in capsys.readouterr().out
    ends = {row["end"]: row for row in rows(out / "attachments.csv")}
    assert (ends["origin"]["bone"], ends["insertion"]["bone"]) == ("bone_proximal", "bone_distal")
    (muscle,) = rows(out / "muscles.csv")
    assert float(muscle["fibre_mm"]) <= float(muscle["path_mm"]) < 60.0
    assert float(muscle["pcsa_mm2"]) == pytest.approx(float(muscle["volume_mm3"]) / float(muscle["fibre_mm"]))
    assert int(muscle["lines_whole"]) >= 0.9 * int(muscle["lines"])
    (carried,) = rows(out / "carried.csv")
    assert float(carried["stretch_min"]) <= float(carried["stretch_mean"]) <= float(carried["stretch_max"])
    assert carried["origin_off_bone_mm"] != ""
    (arm,) = rows(out / "moment_arms.csv")
    assert (arm["coordinate"], float(arm["angle_deg"])) == ("elbow", 25.0)
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["claim"].startswith("map sampled")
    rest, moved = (pv.read(out / name) for name in ("fibres.vtk", "fibres_carried.vtk"))
    assert rest.n_lines == moved.n_lines == int(muscle["lines"])
    assert np.linalg.norm(rest.points - moved.points, axis=1).max() > 1.0


def test_curves_end_where_the_map_ends(rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    given = ["architecture", str(rig), "--out", str(out), "--within-mm", "8", "--curves", "--quiet"]
    assert main([*given, "--set", "deformer.min_steps=3"]) == 0
    states, (carried,), (rest,) = (rows(out / f"{name}.csv") for name in ("curves", "carried", "muscles"))
    assert [float(states[k]["elbow_deg"]) for k in (0, -1)] == [0.0, 25.0]
    assert float(states[0]["path_mm"]) == pytest.approx(float(rest["path_mm"]), rel=0.01)
    for name in ("path_mm", "fibre_mm", "pennation_deg"):
        assert float(states[-1][name]) == pytest.approx(float(carried[name]), rel=0.01)
    assert all(state["moment_arm_path_mm"] for state in states)
    page = (out / "report.html").read_text(encoding="utf-8")
    for what in ("elbow, degrees", "Moment arm by the streamlines", "After the map", "Free ends"):
        assert (what in page) == (what != "Free ends"), what
    assert main([*given, "--rest"]) == 2
    assert "curves need a motion" in capsys.readouterr().err


def test_what_is_printed_is_what_is_written_and_valid_json(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["architecture", str(rig), "--rest", "--out", str(out), "--quiet", "--json"]) == 0

    def refused(word: str) -> float:
        raise AssertionError(f"{word} is no JSON")

    told = json.loads(capsys.readouterr().out, parse_constant=refused)
    written = json.loads((out / "report.json").read_text(encoding="utf-8"), parse_constant=refused)
    assert told.pop("folder") == str(out)
    assert {key: written[key] for key in told} == told


def test_a_rig_that_does_not_arrive_has_no_map_to_carry_by(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    few = ("--set", "deformer.method=own", "--set", "bones.rigid=false", "--set", "deformer.max_steps=1")
    share = ("--set", "deformer.limit_share=0.01")
    assert main(["architecture", str(rig), "--out", str(out), *few, *share]) == 2
    assert "the deformation ended early" in capsys.readouterr().err
    assert not out.exists()


def test_at_rest_nothing_is_deformed(rig: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["architecture", str(rig), "--rest", "--out", str(out), "--quiet"]) == 0
    assert rows(out / "carried.csv") == []
    assert not (out / "fibres_carried.vtk").exists()
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "1 of 1 muscles" in page
    assert "After the map" not in page
    assert json.loads((out / "report.json").read_text(encoding="utf-8"))["claim"] == "at rest"


def test_muscles_that_are_not_asked_for_are_not_looked_at(
    rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two muscles the attachments, sections and fibres of one."""
    (rig.parent / "anatomy" / "muscle_extensor.ply").write_bytes(ply_bytes(egg((0, -13, 0), (25, 5, 5))))
    looked, measured = Mock(wraps=surface_samples), Mock(wraps=Lengthwise.of)
    monkeypatch.setattr(attachments, "surface_samples", looked)
    monkeypatch.setattr(Lengthwise, "of", measured)
    given = ["architecture", str(rig), "--rest", "--within-mm", "8", "--quiet", "--muscles", "*flexor"]
    assert main([*given, "--out", str(tmp_path / "out")]) == 0
    assert (looked.call_count, measured.call_count) == (1, 1)
    assert [row["name"] for row in rows(tmp_path / "out" / "muscles.csv")] == ["muscle_flexor"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--within-mm", "-1"), "within_mm: found -1"),
        (("--muscles", "biceps*"), "no muscle fits 'biceps*'"),
        (("--attachments", "none.csv"), "none.csv: the attachments cannot be read"),
    ],
)
def test_bad_input_is_refused_and_nothing_written(
    options: tuple[str, ...], said: str, rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["architecture", str(rig), "--out", str(tmp_path / "out"), *options]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_streamlines_that_are_known_take_the_place_of_the_flow(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The flow's own streamlines given back: the same paths, every one of them a fibre as a whole."""
    assert main(["architecture", str(rig), "--rest", "--out", str(tmp_path / "flow"), "--quiet"]) == 0
    (flow,) = rows(tmp_path / "flow" / "muscles.csv")
    given = ("--fibres", str(tmp_path / "flow" / "fibres.vtk"))
    assert main(["architecture", str(rig), "--out", str(tmp_path / "data"), *given]) == 0
    said = capsys.readouterr().out
    assert "of 200 streamlines are in muscles" in said
    (data,) = rows(tmp_path / "data" / "muscles.csv")
    assert (flow["fibres"], flow["data_share"]) == ("flow", "")
    assert data["fibres"] == "streamlines of fibres.vtk"
    # Ends that stand out of the surface, by no more than the tets do, are cut: 2 to 3 % of these fibres.
    assert 0.95 < float(data["path_mm"]) / float(flow["path_mm"]) < 1.005
    assert data["fibre_mm"] == data["path_mm"]
    assert float(data["data_share"]) > 0.9
    (carried,) = rows(tmp_path / "data" / "carried.csv")
    assert 0.5 < float(carried["stretch_mean"]) < 1.5
    (use,) = rows(tmp_path / "data" / "fibre_files.csv")
    assert (use["file"], use["lines"], use["directions"]) == ("fibres.vtk", "200", "0")
    # A line along the tets' own surface, which stands out of the given one, is none in a muscle: a few of 200.
    assert int(use["lines_in_muscles"]) == int(data["lines"]) >= 180


def test_directions_that_are_known_take_the_place_of_the_flow(rig: Path, tmp_path: Path) -> None:
    assert main(["architecture", str(rig), "--rest", "--out", str(tmp_path / "flow"), "--quiet"]) == 0
    with np.load(tmp_path / "flow" / "fibres.npz") as stored:
        grid = pv.PolyData(stored["places_mm"] / 10.0)
        grid.point_data["fibres"] = -stored["directions"]
        places, directions = stored["places_mm"], stored["directions"]
    grid.save(tmp_path / "known.vtp")
    given = ("--fibres", str(tmp_path / "known.vtp"), "--fibre-units", "cm")
    assert main(["architecture", str(rig), "--rest", "--out", str(tmp_path / "data"), "--quiet", *given]) == 0
    (data,) = rows(tmp_path / "data" / "muscles.csv")
    assert (data["fibres"], float(data["data_share"])) == ("directions of known.vtp", 1.0)
    with np.load(tmp_path / "data" / "fibres.npz") as stored:
        apart, same = cKDTree(stored["places_mm"]).query(places)
        cosines = np.einsum("ki,ki->k", stored["directions"][same], directions)
    assert apart.max() < 1e-9
    turned = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    assert np.median(turned) < 1.0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--fibre-units", "cm"), "--fibre-units: found no --fibres"),
        (("--fibres", "none.tck"), "none.tck: cannot be read"),
        (("--fibres", "LINES", "--fibre-units", "m"), "none of its fibres is in a muscle: they lie between"),
    ],
)
def test_fibres_that_cannot_be_used_are_refused(
    options: tuple[str, ...], said: str, rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "lines.vtk").write_bytes(vtk_lines([np.eye(3)], title="lines", line_data={}))
    given = [str(tmp_path / "lines.vtk") if option == "LINES" else option for option in options]
    assert main(["architecture", str(rig), "--rest", "--out", str(tmp_path / "out"), *given]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_tendon_sheet_takes_the_place_of_the_area_on_bone(rig: Path, tmp_path: Path) -> None:
    """A sheet across the middle: fibres end there, up to a tetrahedron late on this coarse mesh; attachments stay."""
    assert main(["architecture", str(rig), "--rest", "--out", str(tmp_path / "area"), "--quiet"]) == 0
    ends = {
        row["end"]: np.array([float(row[f"{x}_mm"]) for x in "xyz"]) for row in rows(tmp_path / "area/attachments.csv")
    }
    axis = ends["insertion"] - ends["origin"]
    sheet = pv.Plane(center=0.5 * (ends["insertion"] + ends["origin"]), direction=axis, i_size=60.0, j_size=60.0)
    sheet.triangulate().save(tmp_path / "sheet.stl")
    (tmp_path / "ends.csv").write_text("muscle,end,bone,sheet\nmuscle_flexor,insertion,,sheet.stl\n", encoding="utf-8")
    given = ("--attachments", str(tmp_path / "ends.csv"))
    assert main(["architecture", str(rig), "--rest", "--out", str(tmp_path / "sheet"), "--quiet", *given]) == 0
    (area,), (sheeted,) = (rows(tmp_path / name / "muscles.csv") for name in ("area", "sheet"))
    assert sheeted["fibres"] == "flow by the tendon sheets of insertion"
    assert float(sheeted["path_mm"]) < 0.9 * float(area["path_mm"])
    for key in ("origin", "origin_mm2", "insertion", "insertion_mm2"):
        assert sheeted[key] == area[key]


def test_a_sheet_that_is_not_there_is_refused(rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "ends.csv").write_text("muscle,end,bone,sheet\nmuscle_flexor,origin,,none.stl\n", encoding="utf-8")
    given = ("--attachments", str(tmp_path / "ends.csv"))
    assert main(["architecture", str(rig), "--rest", "--out", str(tmp_path / "out"), *given]) == 2
    assert "line 2: the sheet 'none.stl' is neither a tissue nor a file in" in capsys.readouterr().err
