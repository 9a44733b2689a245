"""The commands about rig files."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import jsonschema
import pytest

import musclefit as mf
from musclefit.cli import main
from musclefit.io.rig_names import builtin_rig_path, builtin_rigs
from musclefit.workflows.schemas import schema

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
        ([str(tmp_path / "new.toml"), "--anatomy", str(tmp_path / "none")], "is not a folder"),
        ([str(tmp_path / "new.toml"), "--joints", str(tmp_path / "none.json")], "cannot be read"),
    ):
        assert main(["init", *arguments]) == 2
        assert words in capsys.readouterr().err
    assert rig.read_bytes() == before
    assert not (tmp_path / "new.toml").exists()


@pytest.mark.parametrize("of", ["rig", "report", "check"])
def test_schemas_are_printed(of: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema", of]) == 0
    printed = json.loads(capsys.readouterr().out)
    jsonschema.Draft202012Validator.check_schema(printed)
    assert printed["$id"] == f"urn:musclefit:{of}"


def test_the_schema_of_rigs_takes_all_of_ours_and_no_other_key() -> None:
    judge = jsonschema.Draft202012Validator(schema("rig"))
    for name in builtin_rigs():
        judge.validate(tomllib.loads(builtin_rig_path(name).read_text(encoding="utf-8")))
    table = tomllib.loads(builtin_rig_path("upper_limb").read_text(encoding="utf-8"))
    for change in (
        {"deformer": {"kernels": "r3"}},
        {"deformer": {"step": "caley"}},
        {"drive": {**table["drive"], "pose": {"elbow": 3}}},
        {"drive": {"kind": "joint"}},
        {"title": 3},
    ):
        assert not judge.is_valid(table | change), change


def test_every_key_of_the_schema_has_its_meaning() -> None:
    made = schema("rig")["properties"]
    records = [*(made[s] for s in made if s not in ("title", "drive")), *made["drive"]["oneOf"]]
    untold = [
        key
        for record in records
        for key, value in record["properties"].items()
        if key != "kind" and not value.get("description")
    ]
    assert untold == []
