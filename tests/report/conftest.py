"""A report that passes, and ways to change one thing in it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from browsers import opened_browser

from musclefit.anatomy.findings import Finding
from musclefit.report.model import CONVERGED, Report, Side
from musclefit.rig.settings import Limits
from musclefit.validate.model import LandmarkCheck, MapCheck, MeshCheck, OverlapCheck, PairOverlap, TissueCheck
from musclefit.vocabulary import Claim


def _tissue(name: str, kind: str, **changed: Any) -> TissueCheck:
    inside = None if kind == "skin" else 0.0
    values: dict[str, Any] = {
        "name": name,
        "kind": kind,
        "rest_volume_mm3": 1000.0,
        "volume_mm3": 1001.0,
        "volume_change_percent": 0.1,
        "rigidity_mm": 0.001 if kind == "bone" else None,
        "rigidity_reference": "prescribed" if kind == "bone" else None,
        "outside_skin_rest_mm3": inside,
        "outside_skin_mm3": inside,
        "outside_skin_introduced_mm3": inside,
    }
    return TissueCheck(**(values | changed))


def _side(**changed: Any) -> Side:
    values: dict[str, Any] = {
        "method": "iterative RBF, r3, row-norm at all points",
        "status": CONVERGED,
        "steps": 5,
        "landmarks": LandmarkCheck(35, 1e-9, "elbow"),
        "map": MapCheck(Claim.SAMPLED, "row-norm", 0.2, 5000, 0, 0.4, (1.0, 2.0, 3.0)),
        "mesh": MeshCheck(900, 0, 0.3, 2.0, Claim.CERTIFIED),
        "tissues": (_tissue("skin", "skin"), _tissue("biceps", "muscle"), _tissue("humerus", "bone")),
        "overlaps": OverlapCheck((PairOverlap("biceps", "humerus", 2.0, 2.5, 0.25),), 3, ()),
    }
    return Side(**(values | changed))


def _report(**changed: Any) -> Report:
    values: dict[str, Any] = {
        "title": "Arm",
        "result": _side(),
        "baseline": None,
        "findings": (Finding("skin", "merged-vertices", "skin: 3 vertices merged"),),
        "limits": Limits(),
        "timings_s": {"read": 0.5, "march": 200.0},
        "peak_memory_mb": 300.0,
        "provenance": {"versions": {"musclefit": "0.1.0"}, "settings": {"pose": (("elbow", 75.0),), "tets": True}},
    }
    return Report(**(values | changed))


@pytest.fixture
def make_tissue() -> Callable[..., TissueCheck]:
    return _tissue


@pytest.fixture
def make_side() -> Callable[..., Side]:
    return _side


@pytest.fixture
def make_report() -> Callable[..., Report]:
    return _report


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """One Chromium for all tests of a file."""
    with opened_browser() as opened:
        yield opened
