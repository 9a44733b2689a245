"""`musclefit import-osim`: a rig of an OpenSim model that runs, follows a .mot, and says what it leaves out."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from tiny_osim import MODEL, opensim_places, write_tiny_osim

import musclefit as mf
from musclefit.cli import main
from musclefit.io.formats.osim import parse_osim
from musclefit.pipeline.sequence import posed_job


def test_bones_and_points_stand_where_opensim_has_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = write_tiny_osim(tmp_path / "model")
    assert main(["import-osim", str(model), str(tmp_path / "rig"), "--quiet", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["bones"], said["open_meshes"], said["muscles"], said["path_points"], said["markers"]) == (
        4,
        0,
        1,
        2,
        1,
    )
    multibody = parse_osim(MODEL.encode(), source="m").multibody
    rotation, translation = opensim_places(model, multibody.values({}))["foot"]
    bone = mf.read_anatomy(tmp_path / "rig" / "bones").anatomy["foot__foot"].surface.vertices
    local = (bone - translation) @ rotation / 1000.0 / (1.0, 1.2, 1.0)
    np.testing.assert_allclose(np.linalg.norm(local, axis=1), 0.02, rtol=1e-5)
    (marker,) = csv.DictReader((tmp_path / "rig" / "markers.csv").read_text().splitlines())
    found = [float(marker[key]) for key in ("x_mm", "y_mm", "z_mm")]
    np.testing.assert_allclose(found, rotation @ (0, 10, 20) + translation, atol=1e-9)


def test_names_of_a_model_are_valid_in_the_rig_and_harmless_in_tables(tmp_path: Path) -> None:
    """Characters beyond 16 bits, quotes, and a name that a spreadsheet would run."""
    model = write_tiny_osim(tmp_path / "model")
    text = model.read_text(encoding="utf-8").replace(
        '<Model name="tiny">', '<Model name="tiny \U0001f9b4 &quot;b&quot;">'
    )
    model.write_text(text.replace('name="puller"', 'name="=1+1"'), encoding="utf-8")
    made = mf.import_osim(model, tmp_path / "rig")
    assert mf.read_rig(tmp_path / "rig" / "rig.toml").rig.title == 'OpenSim model tiny \U0001f9b4 "b"'
    paths = csv.DictReader((made.folder / "muscle_paths.csv").read_text(encoding="utf-8").splitlines())
    assert {row["muscle"] for row in paths} == {"'=1+1"}


def test_the_rig_follows_the_motion_as_opensim_does(tmp_path: Path) -> None:
    model = write_tiny_osim(tmp_path / "model")
    made = mf.import_osim(model, tmp_path / "rig", motion=model.with_name("walk.mot"), progress=None)
    assert "foo" in " ".join(made.notes)
    job = mf.read_rig(tmp_path / "rig" / "rig.toml")
    plan = mf.planned(job)
    assert [pose.time_s for pose in plan.poses] == [0.0, 0.5, 1.0]
    multibody = made.model.multibody
    for pose, degrees, way in zip(plan.poses, (0, -30, -60), (0, 0.01, 0.02), strict=True):
        values = multibody.values({"knee": np.deg2rad(degrees), "tx": way})
        before, after = opensim_places(model, multibody.values({})), opensim_places(model, values)
        motions = posed_job(job, pose).motions
        assert motions is not None
        turn = after["foot"][0] @ before["foot"][0].T
        np.testing.assert_allclose(motions.at(1.0)["foot__foot"].rotation, turn, atol=1e-12)
        moved = motions.at(1.0)["foot__foot"](before["foot"][1][None])[0]
        np.testing.assert_allclose(moved, after["foot"][1], atol=1e-9)


def test_a_pose_and_a_sequence_of_a_mot_run_through(tmp_path: Path) -> None:
    model = write_tiny_osim(tmp_path / "model")
    mf.import_osim(model, tmp_path / "rig", progress=None)
    rig = str(tmp_path / "rig" / "rig.toml")
    settings = ["deformer.method=yu2014", "certificate.enabled=false"]
    done = mf.run(rig, overrides=["drive.pose={knee_deg=-20}", *settings], tets=False, pictures=False, progress=None)
    assert done.job.pose == (("knee", -20.0),)
    walked = mf.sequence(
        rig,
        model.with_name("walk.mot"),
        out=tmp_path / "frames",
        overrides=settings,
        pictures=False,
        between=False,
        progress=None,
    )
    assert [frame.outcome for frame in walked.report.frames] == ["made"] * 3


def test_a_sequence_follows_markers_and_tells_residuals(tmp_path: Path) -> None:
    """One marker alone fixes three coordinates of thirteen; the report names the others."""
    model = write_tiny_osim(tmp_path / "model")
    mf.import_osim(model, tmp_path / "rig", progress=None)
    rotation, translation = opensim_places(model, parse_osim(MODEL.encode(), source="m").multibody.values({}))["foot"]
    x, y, z = (rotation @ (0, 10, 20) + translation).tolist()
    lines = ["PathFileType\t4\t(X/Y/Z)\tx.trc", "NumFrames\tNumMarkers\tUnits", "2\t1\tmm", "Frame#\tTime\theel\t\t"]
    lines += ["\t\tX1\tY1\tZ1", f"1\t0\t{x!r}\t{y!r}\t{z!r}", f"2\t0.1\t{x + 20!r}\t{y!r}\t{z!r}"]
    (tmp_path / "step.trc").write_text("\n".join(lines) + "\n")
    done = mf.sequence(
        tmp_path / "rig" / "rig.toml",
        tmp_path / "step.trc",
        out=tmp_path / "frames",
        overrides=["deformer.method=yu2014", "certificate.enabled=false"],
        pictures=False,
        between=False,
        progress=None,
    )
    assert [frame.outcome for frame in done.report.frames] == ["made"] * 2
    told = json.loads((tmp_path / "frames" / "report.json").read_text())["findings"]
    found = {finding["code"]: finding["message"] for finding in told}
    assert found["marker-residuals"].startswith("1 markers by OpenSim's inverse kinematics")
    assert "knee" in found["coordinates-open"]
    assert "coordinates are not fixed by the markers" in (tmp_path / "frames" / "report.html").read_text()


@pytest.mark.parametrize(
    ("key", "found"),
    [("markers_up=z", "drive.markers_up: has no effect"), ("markers_shift_mm=[1,2]", "has 2 numbers; expected x, y")],
)
def test_keys_of_markers_that_have_no_meaning_are_refused(tmp_path: Path, key: str, found: str) -> None:
    model = write_tiny_osim(tmp_path / "model")
    mf.import_osim(model, tmp_path / "rig", progress=None)
    with pytest.raises(mf.RigError, match=found):
        mf.read_rig(tmp_path / "rig" / "rig.toml", overrides=[f"drive.{key}"])
    with pytest.raises(mf.InputError, match="no effect without a"):
        mf.import_osim(model, tmp_path / "other", markers_up="z")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda m: (m.parent / "Geometry" / "foot.stl").unlink(),
            "neither .*: foot.stl; name their folder",
        ),
        (lambda m: m.unlink(), "cannot be read"),
        (lambda m: (m.parent / "Geometry" / "foot.stl").write_bytes(b"solid x"), "foot.stl: "),
        (lambda m: m.write_text(MODEL[:2000]), "is not valid XML"),
    ],
)
def test_bad_models_end_with_2_and_a_remedy(
    tmp_path: Path, change: object, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    import re

    model = write_tiny_osim(tmp_path / "model")
    change(model)  # type: ignore[operator]
    assert main(["import-osim", str(model), str(tmp_path / "rig"), "--quiet"]) == 2
    assert re.search(said, capsys.readouterr().err)
    assert not (tmp_path / "rig").exists()


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        ("{knie_deg=10}", "did you mean 'knee'"),
        ("{knee_deg=-170}", "range is -114.6 to 114.6"),
        ("{tilt_deg=5}", "is locked in the model"),
        ("{cap_angle_deg=5}", "follows 'knee' by a coupler"),
        ("{tx_deg=5}", "is translational, no angle"),
    ],
)
def test_poses_that_the_model_cannot_take(tmp_path: Path, pose: str, said: str) -> None:
    mf.import_osim(write_tiny_osim(tmp_path / "model"), tmp_path / "rig", progress=None)
    with pytest.raises(mf.InputError, match=said):
        mf.read_rig(tmp_path / "rig" / "rig.toml", overrides=[f"drive.pose={pose}"])


def test_a_mot_without_a_model_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(mf.InputError, match="musclefit import-osim"):
        mf.read_motion(tmp_path / "walk.mot")
