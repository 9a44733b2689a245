"""Markers of a .trc file: read as landmarks, and moved with everything else of the file kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from musclefit.errors import LandmarkError
from musclefit.io.formats.landmarks import paired, read_landmarks
from musclefit.io.formats.trc import read_trajectories
from musclefit.vocabulary import Unit

TRC = (
    "PathFileType\t4\t(X/Y/Z)\tstatic.trc\n"
    "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
    "100\t100\t2\t3\tm\t100\t1\t2\n"
    "Frame#\tTime\tASIS\t\t\tKNEE\t\t\tTOE\t\t\n"
    "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\tX3\tY3\tZ3\n"
    "\n"
    "1\t0.00\t0.1\t0.2\t0.3\t1\t2\t3\t\t\t\n"
    "2\t0.01\t0.1\t0.2\t0.5\t1\t2\t3\t7\t8\t9\n"
)


def test_markers_stand_at_their_means_in_mm(tmp_path: Path) -> None:
    (tmp_path / "static.trc").write_text(TRC)
    table = read_landmarks(tmp_path / "static.trc")
    assert table.names == ("ASIS", "KNEE", "TOE")
    wanted = [[100, 200, 400], [1000, 2000, 3000], [7000, 8000, 9000]]
    np.testing.assert_allclose(table.positions, wanted, rtol=0, atol=1e-9)
    (finding,) = table.findings
    assert finding.code == "averaged-frames"
    assert "2 frames were averaged; the marker that moves most, 'ASIS', is 100 mm from its mean" in finding.message


def test_markers_are_matched_by_name_with_other_files(tmp_path: Path) -> None:
    (tmp_path / "subject.trc").write_text(TRC)
    (tmp_path / "model.csv").write_text("name,x_mm,y_mm,z_mm\nTOE,0,0,0\nASIS,5,5,5\nHEEL,1,1,1\n")
    table = paired(read_landmarks(tmp_path / "model.csv"), read_landmarks(tmp_path / "subject.trc"))
    assert table.names == ("TOE", "ASIS")
    assert table.targets is not None
    np.testing.assert_allclose(table.targets, [[7000, 8000, 9000], [100, 200, 400]], rtol=0, atol=1e-9)
    alone = [f.message for f in table.findings if f.code == "unmatched-landmarks"]
    assert len(alone) == 2
    assert "HEEL" in alone[0]
    assert "KNEE" in alone[1]


def test_moved_markers_keep_the_rest_of_the_file() -> None:
    read = read_trajectories(TRC, "a.trc", units=Unit.MILLIMETRE)
    assert read.seen.shape == (5, 3)
    moved = read.seen + np.array([1000.0, 0.0, 0.0])
    text = read.with_seen(moved)
    again = read_trajectories(text, "a.trc", units=Unit.MILLIMETRE)
    assert text.splitlines()[:6] == TRC.splitlines()[:6]
    np.testing.assert_allclose(again.seen, moved, rtol=0, atol=1e-9)
    assert np.isnan(again.positions[0, 2]).all()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("PathFileType", "Path", "no .trc file"),
        ("\t2\t3\tm\t", "\t3\t3\tm\t", "has 2 frames, but its header says 3"),
        ("\t2\t3\tm\t", "\t2\t4\tm\t", "names 3 markers, but its header says 4"),
        ("\t2\t3\tm\t", "\ttwo\t3\tm\t", "NumFrames is two, no whole number"),
        ("\t2\t3\tm\t", "\t2\t3\tfeet\t", "Units is 'feet'; known are mm, cm, m"),
        ("7\t8\t9", "\t\t", "marker 'TOE' is in no frame"),
        ("0.01\t0.1", "0.01\tx.1", r"line 8: 'x.1' is no number"),
        ("7\t8\t9", "7\t8\t9\t10", r"line 8 has 10 coordinates, not 9"),
        ("KNEE", "ASIS", "two landmarks are named 'ASIS'"),
    ],
)
def test_slips_are_named(tmp_path: Path, old: str, new: str, said: str) -> None:
    (tmp_path / "bad.trc").write_text(TRC.replace(old, new))
    with pytest.raises(LandmarkError, match=rf"bad.trc: .*{said}"):
        read_landmarks(tmp_path / "bad.trc")


@pytest.mark.anatomy
def test_a_recorded_motion_is_read(anatomy_data: Path) -> None:
    table = read_landmarks(anatomy_data / "opensim" / "arm26" / "arm26_elbow_flex.trc")
    assert table.names == ("r_acromion", "r_humerus_epicondyle", "r_radius_styloid")
    assert "121 frames" in table.findings[0].message
