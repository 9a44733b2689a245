"""The commands about rig files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import musclefit as mf
from musclefit.cli import main

JOINTS = {
    "units": "mm, degrees",
    "elbow": {"axis": [1, 0, 0], "centre_mm": [0, 0, 0], "fixed": ["a"], "moving": ["b", "c"]},
    "wrist": {
        "kind": "ball",
        "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "coordinates": ["wrist x", "wrist_y", "wrist_z"],
        "centre_mm": [0, 0, 9],
        "fixed": ["b"],
        "moving": ["c"],
    },
}


def test_all_rigs_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rigs"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == sorted(line.split()[0] for line in lines)
    assert any(line.startswith("upper_limb ") and "MUSCLEFIT_DATA" not in line for line in lines)
    assert any(line.startswith("forearm_rigid ") and "(needs MUSCLEFIT_DATA)" in line for line in lines)


def test_a_new_rig_names_what_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "arm").mkdir()
    table = tmp_path / "tables" / "joints.json"
    table.parent.mkdir()
    table.write_text(json.dumps(JOINTS), encoding="utf-8")
    rig = tmp_path / "rigs" / "my_arm.toml"
    assert main(["init", str(rig), "--anatomy", str(tmp_path / "arm"), "--joints", str(table)]) == 0
    assert f"wrote {rig}: set the pose, then musclefit run {rig}" in capsys.readouterr().out
    text = rig.read_text(encoding="utf-8")
    assert 'folder = "../arm"' in text
    assert 'joints = "../tables/joints.json"' in text
    assert 'pose = { elbow_deg = 10, "wrist x_deg" = 0, wrist_y_deg = 0, wrist_z_deg = 0 }' in text
    with pytest.raises(mf.InputError, match="arm has no surface file"):
        mf.read_rig(rig)  # it is a rig; only the surfaces are missing


def test_what_is_there_is_kept_and_what_is_not_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / "knee.toml"
    assert main(["init", str(rig)]) == 0
    assert "name your surfaces and joints in it" in capsys.readouterr().out
    before = rig.read_bytes()
    for arguments, words in (
        ([str(rig)], "is there already, and is kept"),
        ([str(tmp_path / "knee.txt")], "name one that ends in .toml"),
        ([str(tmp_path / "new.toml"), "--anatomy", str(tmp_path / "none")], "is no folder"),
        ([str(tmp_path / "new.toml"), "--joints", str(tmp_path / "none.json")], "cannot be read"),
    ):
        assert main(["init", *arguments]) == 2
        assert words in capsys.readouterr().err
    assert rig.read_bytes() == before
    assert not (tmp_path / "new.toml").exists()
