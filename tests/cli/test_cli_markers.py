"""Markers of a model and a subject drive a run: matched by name; the unmatched are told before and in the report."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tiny_rigs import landmark_rows, write_tiny_rig

from musclefit.cli import main


def write_markers(folder: Path, *, names: list[str]) -> Path:
    """A rig whose model markers are a CSV and whose subject's are a .trc of two frames, with the given names."""
    rig = write_tiny_rig(folder)
    rows = landmark_rows()[1:]
    model = ["name,x_mm,y_mm,z_mm", *(",".join([row[0], *row[2:5]]) for row in rows), "HEEL,0,0,9"]
    (folder / "model.csv").write_text("\n".join(model) + "\n")
    cells = "\t".join(cell for row in rows for cell in row[5:8])
    heads = ["Frame#", "Time", *(cell for name in names for cell in (name, "", ""))]
    axes = ["", "", *(f"{axis}{k + 1}" for k in range(len(names)) for axis in "XYZ")]
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tsubject.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        f"100\t100\t2\t{len(names)}\tmm",
        "\t".join(heads),
        "\t".join(axes),
        f"1\t0\t{cells}",
        f"2\t0.01\t{cells}",
    ]
    (folder / "subject.trc").write_text("\n".join(lines) + "\n")
    text = rig.read_text().replace('source = "landmarks.csv"', 'source = "model.csv"\ntarget = "subject.trc"')
    rig.write_text(text)
    return rig


def test_a_subject_is_reached_by_its_markers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [row[0] for row in landmark_rows()[1:]]
    rig = write_markers(tmp_path, names=["C7", *names[1:]])
    assert main(["run", str(rig), "--out", str(tmp_path / "out"), "--no-tets", "--no-pictures"]) in (0, 1)
    told = capsys.readouterr().err
    assert f"model.csv: 2 landmarks are not used, subject.trc names none so: {names[0]}, HEEL" in told
    assert "subject.trc: 1 landmarks are not used, model.csv names none so: C7" in told
    assert "subject.trc: 2 frames were averaged" in told
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["landmarks"]["count"] == len(names) - 1
    assert report["landmarks"]["max_error_mm"] <= 1e-6
    assert [f["code"] for f in report["findings"]].count("unmatched-landmarks") == 2


def test_markers_of_which_none_match_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = write_markers(tmp_path, names=[f"M{k}" for k in range(12)])
    assert main(["run", str(rig), "--out", str(tmp_path / "out"), "--no-tets", "--no-pictures"]) == 2
    assert "have no landmark name in common" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
