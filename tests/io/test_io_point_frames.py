"""Attached points in another frame than the anatomy: carried where they are, written in the frame that they came in."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_rigs import write_tiny_rig

import musclefit as mf

AT = np.array([[10.0, 5.0, 3.0], [-20.0, 4.0, -2.0]])
FLIP = np.array([-1.0, -1.0, 1.0])


def markups(path: Path, frame: str, points: np.ndarray) -> Path:
    controls = [{"label": f"p{k}", "position": point} for k, point in enumerate(points.tolist())]
    path.write_text(json.dumps({"markups": [{"coordinateSystem": frame, "controlPoints": controls}]}))
    return path


def fcsv(path: Path, frame: str, points: np.ndarray) -> Path:
    rows = [f"{k},{x},{y},{z},0,0,0,1,1,1,0,p{k},," for k, (x, y, z) in enumerate(points.tolist())]
    head = ["# Markups fiducial file version = 4.11", f"# CoordinateSystem = {frame}"]
    path.write_text(
        "\n".join([*head, "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID", *rows, ""])
    )
    return path


def read_back(path: Path) -> np.ndarray:
    if path.suffix == ".fcsv":
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        return np.array([[float(cell) for cell in line.split(",")[1:4]] for line in lines])
    points = json.loads(path.read_text())["markups"][0]["controlPoints"]
    return np.array([point["position"] for point in points])


@pytest.mark.parametrize("write", [markups, fcsv])
@pytest.mark.parametrize("frame", ["LPS", "RAS"])
def test_points_are_carried_where_they_are_and_written_in_their_own_frame(tmp_path, frame, write):
    rig = write_tiny_rig(tmp_path / "rig")
    ending = "mrk.json" if write is markups else "fcsv"
    flip = FLIP if frame == "RAS" else np.ones(3)
    file = write(tmp_path / f"points.{ending}", frame, AT * flip)
    out = tmp_path / "out"
    overrides = ["anatomy.frame=patient (LPS)"]
    done = mf.run(rig, out=out, points=[file], overrides=overrides, tets=False, pictures=False)
    np.testing.assert_allclose(done.job.further[0].points, AT, rtol=0, atol=1e-12)
    written = read_back(out / "points" / file.name)
    np.testing.assert_allclose(written * flip, done.deformation(AT), rtol=0, atol=1e-9)
    assert frame in (out / "points" / file.name).read_text()


def test_where_only_one_states_its_frame_nothing_is_turned(tmp_path):
    rig = write_tiny_rig(tmp_path / "rig")
    file = markups(tmp_path / "points.mrk.json", "RAS", AT)
    np.testing.assert_array_equal(mf.run(rig, points=[file], tets=False).job.further[0].points, AT)
