"""Motions: interpolation against formulas, frames that meet their ends, refused keyframes and files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musclefit.errors import InputError
from musclefit.io.formats.motions import read_motion
from musclefit.rig.motion import Interpolation, Motion

JUMP = "time_s,knee_deg,ankle_deg,phase\n0,0,0,stand\n0.45,60,20,deepest\n0.7,5,-10,take-off\n1.6,0,0,stand\n"


def motion(*angles: float) -> Motion:
    return Motion(np.arange(len(angles), dtype=float), ("knee",), np.array(angles)[:, None], "m.csv")


def test_lines_are_straight_and_cubics_meet_the_keyframes() -> None:
    jump = motion(0.0, 60.0, 5.0, 0.0)
    linear = jump.at(np.array([0.5, 1.25, 3.0]), interpolation=Interpolation.LINEAR)[:, 0]
    np.testing.assert_allclose(linear, [30.0, 46.25, 0.0], rtol=0, atol=1e-12)
    cubic = jump.at(np.arange(4.0), interpolation=Interpolation.CUBIC)[:, 0]
    np.testing.assert_allclose(cubic, [0.0, 60.0, 5.0, 0.0], rtol=0, atol=1e-12)


@given(st.lists(st.floats(-90, 90).map(lambda angle: round(angle, 9)), min_size=2, max_size=8))
def test_cubics_never_leave_the_keyframes_beside_them(angles: list[float]) -> None:
    between = motion(*angles).at(np.linspace(0, len(angles) - 1, 101), interpolation=Interpolation.CUBIC)[:, 0]
    for time, angle in zip(np.linspace(0, len(angles) - 1, 101), between, strict=True):
        k = min(int(time), len(angles) - 2)
        low, high = sorted((angles[k], angles[k + 1]))
        assert low - 1e-9 <= angle <= high + 1e-9


@pytest.mark.parametrize("interpolation", Interpolation)
def test_frames_are_even_in_time_and_end_exactly(interpolation: Interpolation) -> None:
    poses = motion(0.0, 60.0, 0.1).frames(9, interpolation=interpolation)
    assert [pose.number for pose in poses] == list(range(9))
    np.testing.assert_allclose([pose.time_s for pose in poses], np.linspace(0, 2, 9), rtol=0, atol=1e-15)
    assert (poses[0].angles["knee"], poses[-1].angles["knee"], poses[4].angles["knee"]) == (0.0, 0.1, 60.0)
    said = motion(0.0, 60.0, 0.1).resampling_in_words(9, interpolation=interpolation)
    assert "3 keyframes" in said
    assert "9 frames evenly spaced in time from 0 s to 2 s, one every 0.25 s" in said


def test_a_file_is_read_with_its_remarks(tmp_path: Path) -> None:
    path = tmp_path / "jump.csv"
    path.write_text("\ufeff" + JUMP, encoding="utf-8")
    read = read_motion(path)
    assert read.coordinates == ("knee", "ankle")
    np.testing.assert_array_equal(read.times_s, [0, 0.45, 0.7, 1.6])
    np.testing.assert_array_equal(read.degrees[2], [5, -10])


REFUSED = {
    "empty": ("", r"is empty; expected the columns time_s and <coordinate>_deg"),
    "no time": ("knee_deg\n1\n", "no column time_s; found are: knee_deg"),
    "unknown column": ("time_s,knee\n0,1\n1,2\n", "column 'knee' is unknown; known are time_s, <coordinate>_deg"),
    "doubled column": ("time_s,knee_deg,knee_deg\n0,1,1\n", "two columns are named 'knee_deg'"),
    "a word": ("time_s,knee_deg\n0,1\n1,bent\n", "line 3: knee_deg is 'bent', no finite number"),
    "infinite": ("time_s,knee_deg\n0,1\n1,inf\n", "line 3: knee_deg is 'inf', no finite number"),
    "short line": ("time_s,knee_deg\n0,1\n1\n", "line 3 has 1 values for 2 columns"),
    "one keyframe": ("time_s,knee_deg\n0,1\n", "holds 1 keyframes; a motion needs at least 2"),
    "falling time": ("time_s,knee_deg\n1,1\n0,1\n", "time 0 s follows 1 s; keyframe times must rise"),
    "no coordinate": ("time_s,phase\n0,a\n1,b\n", "0 coordinates"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_wrong_files_are_refused_by_name(name: str, tmp_path: Path) -> None:
    text, message = REFUSED[name]
    path = tmp_path / "m.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=rf"m\.csv: .*{message}"):
        read_motion(path)


def test_a_missing_file_and_times_outside_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the motion cannot be read"):
        read_motion(tmp_path / "none.csv")
    with pytest.raises(InputError, match=r"asked for 2\.5 s; the motion is from 0 to 2 s"):
        motion(0, 1, 2).at(np.array([1.0, 2.5]), interpolation=Interpolation.CUBIC)
    with pytest.raises(InputError, match="found 1 frames; a sequence needs at least 2"):
        motion(0, 1, 2).frames(1, interpolation=Interpolation.CUBIC)
