"""Landmarks off their bones are named, with the error of frame or unit that would explain it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_rigs import TISSUES, landmark_rows, write_landmarks, write_tiny_rig

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.cli import main
from musclefit.geometry.meshes import TriMesh
from musclefit.rig.handles import Handles
from musclefit.rig.off_bones import off_bone_findings

PLACE = np.array([110.0, 60.0, 35.0])
BONES = ("bone_proximal", "bone_distal")
ANATOMY = Anatomy(
    tuple(Tissue(n, TissueKind.BONE, TriMesh(TISSUES[n].vertices + PLACE, TISSUES[n].faces)) for n in BONES), "mm"
)
ON_BONES = np.concatenate([TISSUES[name].vertices[::40] + PLACE for name in BONES])
OWNERS = tuple(BONES[k // (len(ON_BONES) // 2)] for k in range(len(ON_BONES)))


def said(places: np.ndarray, owners: tuple[str, ...] = OWNERS) -> str:
    handles = Handles(tuple(f"L{k}" for k in range(len(places))), places, owners)
    return " ".join(f.message for f in off_bone_findings(handles, ANATOMY, subject="l.csv"))


def test_on_inside_and_near_their_bones_nothing_is_told() -> None:
    assert said(ON_BONES) == ""
    assert said(ON_BONES + np.array([0.0, 0.0, 9.0])) == ""
    assert said(np.array([(-25.0, 0.0, 0.0), (25.0, 0.0, 0.0)]) + PLACE, BONES) == ""
    assert said(ON_BONES * 5.0, ("",) * len(ON_BONES)) == ""


@pytest.mark.parametrize(
    ("by", "word"),
    [
        ((-1, -1, 1), "RAS has against LPS"),
        ((-1, 1, 1), "x had the other sign"),
        ((1, 1, -1), "z had the other sign"),
        ((1e-3,) * 3, "unit were m"),
        ((10.0,) * 3, "a tenth"),
    ],
)
def test_the_error_that_explains_it_is_named(by: tuple[float, ...], word: str) -> None:
    told = said(ON_BONES * np.array(by))
    assert f"{len(ON_BONES)} of {len(ON_BONES)} landmarks stand more than 10 mm outside" in told
    assert word in told


def test_one_off_its_bone_is_named_with_its_distance() -> None:
    places = np.array([(-25.0, 0.0, 0.0), (25.0, 0.0, 36.0)]) + PLACE
    assert "(L1 30 mm from bone_distal); where they are no markers on the skin" in said(places, BONES)


def test_the_terminal_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = write_tiny_rig(tmp_path / "rig")
    rows = landmark_rows()
    for row in rows[1:]:
        row[2], row[5] = (repr(float(row[k]) + 80.0) for k in (2, 5))
    write_landmarks(rig.parent / "landmarks.csv", rows)
    main(["run", str(rig), "--no-pictures", "--set", "certificate.enabled=false"])
    assert "12 of 12 landmarks stand more than 10 mm outside the bones" in capsys.readouterr().err
