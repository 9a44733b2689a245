"""States on the way and smoothed landmarks, from a rig to the folder that is written."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

import musclefit
from musclefit.errors import RigError
from musclefit.io.anatomy import read_anatomy
from musclefit.pipeline.intermediate_states import states

RIG = """
title = "Bar"
[anatomy]
folder = "tissues"
[drive]
kind = "landmarks"
source = "pairs.csv"
[deformer]
step = "cayley"
kernel = "r3"
min_steps = 3
[tets]
enabled = false
"""
CORNERS = np.array([[i, j, k] for i in (0.0, 1.0) for j in (0.0, 1.0) for k in (0.0, 1.0)]) * [10.0, 10.0, 40.0]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A bar whose 8 corners are landmarks that go up, and sideways by their height, with 0.5 mm of noise."""
    (tmp_path / "tissues").mkdir()
    faces = [t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))]
    head = "ply\nformat ascii 1.0\nelement vertex 8\nproperty double x\nproperty double y\nproperty double z\n"
    head += "element face 12\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(repr, map(float, v))) for v in CORNERS] + ["3 " + " ".join(map(str, f)) for f in faces]
    (tmp_path / "tissues" / "muscle_bar.ply").write_text(head + "\n".join(rows) + "\n")
    noise = np.random.default_rng(0).normal(scale=0.5, size=CORNERS.shape)
    targets = CORNERS + np.stack([0.2 * CORNERS[:, 2], 0.0 * CORNERS[:, 0], 5.0 + 0.0 * CORNERS[:, 0]], axis=1) + noise
    lines = ["name,x_mm,y_mm,z_mm,target_x_mm,target_y_mm,target_z_mm"]
    lines += [f"p{i}," + ",".join(repr(float(x)) for x in (*CORNERS[i], *targets[i])) for i in range(8)]
    (tmp_path / "pairs.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "bar.toml").write_text(RIG)
    return tmp_path / "bar.toml"


def test_states_lead_to_the_result_and_are_written(rig: Path, tmp_path: Path) -> None:
    job = musclefit.read_rig(rig)
    result = musclefit.retarget(job, tets=None)
    found = list(states(result))
    assert [state.at for state in found] == pytest.approx([1 / 3, 2 / 3, 1.0], abs=1e-12)
    for state in found:  # every handle is a vertex, and Cayley steps meet the path at the end of each stretch
        np.testing.assert_allclose(state.anatomy.vertices(), job.path.position(state.at), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found[-1].anatomy.vertices(), result.result.deformed.vertices())
    musclefit.save(result, tmp_path / "out", intermediate=True)
    rows = list(csv.reader((tmp_path / "out" / "intermediate" / "states.csv").read_text().splitlines()))
    assert rows[0] == ["state", "share_of_the_way"]
    assert [row[0] for row in rows[1:]] == ["01", "02", "03"]
    for row, state in zip(rows[1:], found, strict=True):
        assert float(row[1]) == state.at
        read = read_anatomy(tmp_path / "out" / "intermediate" / row[0]).anatomy
        np.testing.assert_array_equal(read.vertices(), state.anatomy.vertices())


def test_smoothing_misses_noisy_landmarks_and_says_by_how_much(rig: Path) -> None:
    exact, smoothed = (
        musclefit.retarget(musclefit.read_rig(rig, overrides=[f"deformer.smoothing={s}"]), tets=None) for s in (0, 1e5)
    )
    assert exact.result.side.landmarks.max_error_mm < 1e-9
    job = smoothed.job
    missed = np.linalg.norm(smoothed.result.deformation(job.handles.source) - job.path.position(1.0), axis=1)
    assert 0.1 < missed.max() < 2.0
    assert smoothed.result.side.landmarks.max_error_mm == pytest.approx(missed.max(), abs=1e-9)
    assert "smoothing 100000" in smoothed.result.side.method
    assert smoothed.report.verdict == "failed"


def test_smoothing_has_no_place_in_free_form_deformation(rig: Path) -> None:
    with pytest.raises(RigError, match=r"deformer.smoothing: has no effect on backend \"ffd\""):
        musclefit.read_rig(rig, overrides=["deformer.backend=ffd", "deformer.smoothing=1.0"])
    with pytest.raises(RigError, match=r"deformer.smoothing: found -1.0; expected a finite number of at least 0"):
        musclefit.read_rig(rig, overrides=["deformer.smoothing=-1.0"])
