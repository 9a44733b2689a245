"""Real segmentations with overlaps become layered sets with a clearance, and what loses much is named; slow."""

from __future__ import annotations

import json

import pytest

from musclefit.cli import main
from musclefit.io.anatomy import read_anatomy
from musclefit.progress import Silent
from musclefit.validate.overlaps import rest_overlaps


@pytest.mark.slow
@pytest.mark.parametrize(("limb", "overlapping"), [("arm", 156), ("leg", 246)])
def test_a_segmented_limb_becomes_disjoint(tmp_path, anatomy_data, limb, overlapping):
    given = anatomy_data / limb / "as_segmented"
    out = tmp_path / "out"
    options = ["--resolve", "priority", "--limit-mm", "0.6", "--local-only", "--quiet"]
    assert main(["repair", str(given), str(out), *options]) == 1  # thin tissues lie half inside their neighbours
    report = json.loads((out / "report.json").read_text())
    real = [pair for pair in report["overlaps_resolved"] if pair["overlap_mm3"] >= 0.95]
    assert abs(len(real) - overlapping) <= 0.05 * overlapping  # the table lists pairs from 1 mm³ on
    assert all(not cut["faults_after"] for cut in report["cuts"])
    assert all(not surface["faults_after"] for surface in report["surfaces"])
    assert report["pairs_that_still_meet"] == []
    failed = [check for check in report["checks"] if not check["passed"]]
    assert {check["name"] for check in failed} <= {"change of volume", "pieces"}
    lost = [one for one in report["tissues"] if abs(one["change_percent"]) > 5.0]
    assert [check["place"].split(":")[0] for check in failed if check["name"] == "change of volume"] == [
        one["name"] for one in lost
    ]
    assert len(report["pairs_below_clearance"]) <= 0.02 * len(report["overlaps_resolved"])
    found = rest_overlaps(read_anatomy(out).anatomy, progress=Silent())
    assert found.pairs == ()
    assert found.not_checked == ()
