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
    ("said", "scale"),
    [("MM", 1.0), ("mm", 1.0), ("millimeters", 1.0), ("Meters", 1000.0), ("metres", 1000.0), ("CM", 10.0)],
)
def test_units_are_known_by_their_names_too(said: str, scale: float) -> None:
    read = read_trajectories(TRC.replace("\tm\t", f"\t{said}\t"), "a.trc", units=Unit.CENTIMETRE)
    np.testing.assert_allclose(read.positions[1, 2], scale * np.array([7.0, 8.0, 9.0]), rtol=1e-15, atol=0)


def test_blanks_for_tabs_are_read_and_a_missing_marker_is_refused() -> None:
    lines = TRC.replace("\t\t\t\n2", "\t4\t5\t6\n2").replace("1\t2\t3\t\t\t\n", "1\t2\t3\t4\t5\t6\n").splitlines()
    blank = "\n".join("   ".join(line.split()) for line in lines)
    read, wanted = (read_trajectories(text, "a.trc", units=Unit.MILLIMETRE) for text in (blank, "\n".join(lines)))
    assert read.names == wanted.names == ("ASIS", "KNEE", "TOE")
    np.testing.assert_array_equal(read.positions, wanted.positions)
    again = read_trajectories(read.with_seen(read.seen + 1.0), "a.trc", units=Unit.MILLIMETRE)
    np.testing.assert_allclose(again.positions, wanted.positions + 1.0, rtol=0, atol=1e-9)
    with pytest.raises(LandmarkError, match=r"line 8 has 8 coordinates, not 9, and blanks part them"):
        read_trajectories(blank.rsplit(" ", 1)[0], "a.trc", units=Unit.MILLIMETRE)


def test_a_marker_at_zero_is_lost_and_no_part_of_its_mean(tmp_path: Path) -> None:
    (tmp_path / "lost.trc").write_text(
        TRC.replace("\t\t\t\n2", "\t0\t0.0\t0\n2").replace("3\t\t\t\n", "3\t0\t0.0\t0\n")
    )
    table = read_landmarks(tmp_path / "lost.trc")
    np.testing.assert_allclose(table.positions[2], [7000, 8000, 9000], rtol=0, atol=1e-9)
    assert [f.code for f in table.findings] == ["averaged-frames", "lost-marker"]
    assert "marker 'TOE' is written 0 0 0 in 1 of 2 frames" in table.findings[1].message
    read = read_trajectories((tmp_path / "lost.trc").read_text(), "a.trc", units=Unit.MILLIMETRE)
    moved = read.with_seen(read.seen + 5.0)
    assert moved.splitlines()[6].endswith("\t0\t0.0\t0")  # as it was
    (tmp_path / "never.trc").write_text(TRC.replace("7\t8\t9", "0\t0\t0"))
    with pytest.raises(LandmarkError, match="marker 'TOE' is in no frame but at 0 0 0, which is how lost markers are"):
        read_landmarks(tmp_path / "never.trc")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("PathFileType", "Path", "no .trc file"),
        ("\t2\t3\tm\t", "\t3\t3\tm\t", "has 2 frames, but its header says 3"),
        ("\t2\t3\tm\t", "\t2\t4\tm\t", "names 3 markers, but its header says 4"),
        ("\t2\t3\tm\t", "\ttwo\t3\tm\t", "NumFrames is two, no whole number"),
        ("\t2\t3\tm\t", "\t2\t3\tfeet\t", "Units is 'feet'; known are mm, cm, m"),
        ("7\t8\t9", "\t\t", "marker 'TOE' is in no frame"),
        ("0.01\t0.1", "0.01\tx.1", r"line 8: 'x.1' is not a number"),
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
