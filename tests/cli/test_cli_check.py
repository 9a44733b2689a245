"""``check`` goes on past surfaces that cannot be used, names repair, and fails on what it is told to."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from tiny_rigs import egg

from musclefit.cli import main
from musclefit.geometry.meshes import TriMesh
from musclefit.io.run_folder import ply_bytes


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
    assert "none of 2 surfaces can be used; mend them with musclefit repair" in said
    assert "not closed" in said
