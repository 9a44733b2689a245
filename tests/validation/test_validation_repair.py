"""Real segmentations with overlaps become layered sets that share no point; slow."""

from __future__ import annotations

import json

import pytest

from musclefit.cli import main
from musclefit.io.surfaces import read_anatomy
from musclefit.progress import Silent
from musclefit.validate.overlaps import rest_overlaps


@pytest.mark.slow
@pytest.mark.parametrize(("limb", "overlapping"), [("arm", 156), ("leg", 246)])
def test_a_segmented_limb_becomes_disjoint(tmp_path, anatomy_data, limb, overlapping):
    given = anatomy_data / limb / "as_segmented"
    out = tmp_path / "out"
    options = ["--resolve", "priority", "--limit-mm", "0.6", "--local-only", "--quiet"]
    assert main(["repair", str(given), str(out), *options]) == 0
    report = json.loads((out / "report.json").read_text())
    real = [pair for pair in report["overlaps_resolved"] if pair["overlap_mm3"] >= 0.95]
    assert abs(len(real) - overlapping) <= 0.05 * overlapping  # the table lists pairs from 1 mm³ on
    assert all(not cut["faults_after"] for cut in report["cuts"])
    assert all(not surface["faults_after"] for surface in report["surfaces"])
    assert report["pairs_that_still_meet"] == []
    found = rest_overlaps(read_anatomy(out).anatomy, progress=Silent())
    assert found.pairs == ()
    assert found.not_checked == ()
