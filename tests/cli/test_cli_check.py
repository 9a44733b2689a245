"""``check`` goes on past surfaces that cannot be used, names repair, and fails on what it is told to."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from tiny_rigs import egg

from musclefit import check, repair
from musclefit.anatomy.findings import Finding
from musclefit.cli import main
from musclefit.geometry.meshes import TriMesh
from musclefit.io.run_folder import ply_bytes
from musclefit.report.next_steps import after_findings, with_next_steps
from musclefit.validate.closeness import CLOSE
from musclefit.workflows.check import FAULTS


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A bone, an open muscle, a damaged one, and two balls as one tissue."""
    place = tmp_path / "anatomy"
    place.mkdir()
    ball = egg((0.0, 0.0, 0.0), (10.0, 10.0, 10.0))
    (place / "bone_a.ply").write_bytes(ply_bytes(ball))
    away = TriMesh(ball.vertices + 50.0, ball.faces)
    (place / "muscle_open.ply").write_bytes(ply_bytes(TriMesh(away.vertices, away.faces[3:])))
    (place / "muscle_cut.ply").write_bytes(ply_bytes(away)[:-20])
    vertices = np.concatenate([ball.vertices + 100.0, ball.vertices + 150.0])
    both = TriMesh(vertices, np.concatenate([ball.faces, ball.faces + len(ball.vertices)]))
    (place / "muscle_two.ply").write_bytes(ply_bytes(both))
    return place


def test_it_goes_on_past_the_first_bad_surface_and_names_repair(folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["check", str(folder), "--out", str(out)]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "'muscle_open' is not closed" in said
    assert "muscle_cut.ply: ends within its" in said
    assert "musclefit repair" in said
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == "failed"
    assert {item["name"] for item in report["tissues"]} == {"bone_a", "muscle_two"}
    assert len(report["not_checked"]) == 2
    suite = ElementTree.parse(out / "report.junit.xml").getroot()
    failed = [case.get("name") for case in suite if case.find("failure") is not None]
    assert failed == ["not checked", "muscle_cut", "muscle_open"]
    assert suite.get("failures") == "3"


@pytest.mark.parametrize("code", [*FAULTS, *CLOSE])
def test_every_finding_of_a_check_has_a_next_step(code):
    found = Finding("bone_a", code, "bone_a: something")
    assert with_next_steps([found])[0].next_step.endswith(".")
    assert after_findings(code).startswith(with_next_steps([found])[0].next_step)


def test_findings_stand_with_their_next_steps_in_the_terminal_the_page_and_the_json(folder, tmp_path, capsys):
    ball = egg((0.0, 0.0, 0.0), (10.0, 10.0, 10.0))
    crossing = np.concatenate([ball.vertices, ball.vertices + 8.0]) + 300.0
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    (folder / "muscle_crossing.ply").write_bytes(ply_bytes(TriMesh(crossing, faces)))
    out = tmp_path / "out"
    assert main(["check", str(folder), "--out", str(out), "--fail-on", "self-crossing"]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "next, for self-crossing: Remove it with musclefit repair IN OUT." in said
    assert said.count("next, for pieces:") == 1
    assert "next: Remove it with musclefit repair IN OUT. To allow it, remove self-crossing from --fail-on." in said
    report = json.loads((out / "report.json").read_text())
    steps = {found["code"]: found["next_step"] for found in report["findings"]}
    assert steps["self-crossing"] == "Remove it with musclefit repair IN OUT."
    assert steps["unusable"] == ""  # its message says it
    assert "Next: Remove it with musclefit repair IN OUT." in (out / "report.html").read_text()


@pytest.mark.parametrize("code", ["merged-vertices", "repeated-faces", "turned-faces", "inside-out", "self-crossing"])
def test_repair_does_what_the_next_step_says(code, tmp_path):
    ball = egg((0.0, 0.0, 0.0), (10.0, 10.0, 10.0))
    vertices, faces = ball.vertices, ball.faces.copy()
    if code == "merged-vertices":
        vertices = vertices[faces].reshape(-1, 3)
        faces = np.arange(len(vertices)).reshape(-1, 3)
    elif code == "repeated-faces":
        faces = np.concatenate([faces, faces[:1]])
    elif code == "turned-faces":
        faces[5] = faces[5][::-1]
    elif code == "inside-out":
        faces = faces[:, ::-1]
    else:
        vertices = np.concatenate([vertices, vertices + 8.0])
        faces = np.concatenate([faces, faces + len(ball.vertices)])
    faulty, mended = tmp_path / "bone.ply", tmp_path / "mended" / "bone.ply"
    mended.parent.mkdir()
    faulty.write_bytes(ply_bytes(TriMesh(vertices, faces)))
    before = {found.code: found.next_step for found in check(faulty).report.findings}
    assert "musclefit repair IN OUT" in before[code]
    repair(faulty, mended)
    assert code not in {found.code for found in check(mended).report.findings}


def test_it_fails_on_what_it_is_told_to(folder, capsys):
    good = [str(folder / "bone_a.ply"), str(folder / "muscle_two.ply")]
    assert main(["check", *good, "--quiet"]) == 0
    assert main(["check", *good, "--quiet", "--fail-on", "self-crossing,non-manifold"]) == 0
    assert main(["check", *good, "--fail-on", "self-crossing,pieces"]) == 1
    assert "pieces" in capsys.readouterr().out
    assert main(["check", *good, "--fail-on", "holes"]) == 2
    assert "fail_on: found 'holes'; known are self-crossing" in capsys.readouterr().err


def test_without_a_surface_that_can_be_used_it_is_bad_input(folder, capsys):
    bad = [str(folder / "muscle_open.ply"), str(folder / "muscle_cut.ply")]
    assert main(["check", *bad]) == 2
    said = capsys.readouterr().err
    assert "none of 2 surfaces can be used: " in said
    assert "Close it with musclefit repair IN OUT" in said
    assert "not closed" in said
