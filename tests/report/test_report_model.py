"""The verdict: what keeps its limits passes, and whatever is missing, not finite or unchecked fails."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from musclefit.report.comparison import compare, worst_first
from musclefit.report.model import MeshLimits, MeshReport, TissueSummary, absent, checks_against
from musclefit.rig.settings import Limits
from musclefit.validate.model import LandmarkCheck, NotChecked, OverlapCheck, PairOverlap
from musclefit.vocabulary import Claim


def _failed(report):
    return {check.name for check in report.checks if not check.passed}


def test_a_run_within_its_limits_passes_and_every_limit_is_held(make_report):
    report = make_report()
    assert report.verdict == "passed"
    assert {check.name: check.limit for check in report.checks} == {
        "not converged": 0.0,
        "landmark error": 1e-6,
        "folded points": 0.0,
        "map refuted": 0.0,
        "inverted tets": 0.0,
        "mesh refuted": 0.0,
        "bone off rigid": 0.01,
        "muscle volume change": 1.0,
        "introduced overlap": 1.0,
        "grown overlap": 1.0,
        "introduced outside skin": 1.0,
        "not checked": 0.0,
    }


def _pairs(*introduced):
    pairs = tuple(PairOverlap("a", f"b{i}", 0.0, v, v) for i, v in enumerate(introduced))
    return OverlapCheck(pairs, 9, ())


def test_overlap_that_was_there_at_rest_has_a_limit_of_its_own(make_report, make_side):
    pairs = (PairOverlap("a", "b", 0.0, 0.5, 0.5), PairOverlap("a", "c", 100.0, 130.0, 7.0))
    side = make_side(overlaps=OverlapCheck(pairs, 9, ()))
    report = make_report(result=side, limits=replace(Limits(), grown_overlap_mm3=8.0))
    checks = {check.name: check for check in report.checks}
    assert (checks["introduced overlap"].value, checks["introduced overlap"].place) == (0.5, "a / b")
    assert (checks["grown overlap"].value, checks["grown overlap"].place) == (7.0, "a / c")
    assert _failed(report) == set()
    assert _failed(make_report(result=side)) == {"grown overlap"}


def _with(**changed):
    """A change of the whole side."""
    return lambda side, _tissue: replace(side, **changed)


def _map(**changed):
    return lambda side, _tissue: replace(side, map=replace(side.map, **changed))


def _mesh(**changed):
    return lambda side, _tissue: replace(side, mesh=replace(side.mesh, **changed))


def _more(kind, **changed):
    """One more tissue."""
    return lambda side, tissue: replace(side, tissues=(*side.tissues, tissue("m", kind, **changed)))


SABOTAGE = {
    "stalled": (_with(status="no safe step is left"), "not converged"),
    "landmark far": (_with(landmarks=LandmarkCheck(3, 1e-5, "x")), "landmark error"),
    "landmark nan": (_with(landmarks=LandmarkCheck(3, math.nan, "x")), "landmark error"),
    "one fold": (_map(folded_points=1), "folded points"),
    "det nan": (_map(min_jacobian_determinant=math.nan), "folded points"),
    "det negative": (_map(min_jacobian_determinant=-1.0), "folded points"),
    "det infinite": (_map(min_jacobian_determinant=math.inf), "folded points"),
    "no point tested": (_map(points_tested=0), "folded points"),
    "map refuted": (_map(claim=Claim.REFUTED), "map refuted"),
    "points left out": (_map(claim=Claim.CERTIFIED, not_covered=("markers.trc",)), "outside the proof"),
    "one inverted": (_mesh(inverted=1), "inverted tets"),
    "no tet": (_mesh(tets=0), "inverted tets"),
    "ratio nan": (_mesh(min_volume_ratio=math.nan), "inverted tets"),
    "ratio below zero": (_mesh(min_volume_ratio=-0.1), "inverted tets"),
    "boundary crosses": (_mesh(claim=Claim.REFUTED), "mesh refuted"),
    "bone bends": (_more("bone", rigidity_mm=2.0), "bone off rigid"),
    "bone unknown": (_more("bone", rigidity_mm=None), "bone off rigid"),
    "bone nan": (_more("bone", rigidity_mm=math.nan), "bone off rigid"),
    "muscle shrinks": (_more("muscle", volume_change_percent=-3.0), "muscle volume change"),
    "muscle unknown": (_more("muscle", volume_change_percent=math.nan), "muscle volume change"),
    "many small overlaps": (_with(overlaps=_pairs(*[0.02] * 60)), "introduced overlap"),
    "overlap nan": (_with(overlaps=_pairs(math.nan)), "introduced overlap"),
    "overlap infinite": (_with(overlaps=_pairs(math.inf)), "introduced overlap"),
    "negative overlap hides one": (_with(overlaps=_pairs(5.0, -5.0)), "introduced overlap"),
    "outside skin": (_more("muscle", outside_skin_introduced_mm3=1.5), "introduced outside skin"),
    "outside skin unknown": (_more("muscle", outside_skin_introduced_mm3=None), "introduced outside skin"),
    "left out": (_with(overlaps=OverlapCheck((), 3, (NotChecked("m", "open"),))), "not checked"),
}


@pytest.mark.parametrize("case", SABOTAGE)
def test_one_fault_fails_the_run_by_its_name_alone(case, make_report, make_side, make_tissue):
    spoil, name = SABOTAGE[case]
    report = make_report(result=spoil(make_side(), make_tissue))
    assert _failed(report) == {name}
    assert report.verdict == "failed"


@pytest.mark.parametrize("beside", ["baseline", "paper_loop"])
def test_what_a_result_is_compared_with_never_changes_the_verdict(beside, make_report, make_side):
    report = make_report(**{beside: make_side(status="stalled", steps=1)})
    assert report.verdict == "passed"


def test_infinite_values_pass_not_even_without_a_limit():
    pairs = (PairOverlap("a", "b", math.inf, math.inf, 0.0),)
    report = replace(_inspection(pairs), limits=MeshLimits(overlap_mm3=math.inf))
    assert _failed(report) == {"overlap"}


def test_a_check_names_the_worst_place(make_side, make_tissue):
    side = make_side(
        tissues=(
            make_tissue("a", "bone", rigidity_mm=0.5),
            make_tissue("b", "bone", rigidity_mm=1.5),
            make_tissue("c", "muscle", volume_change_percent=0.5),
            make_tissue("d", "muscle", volume_change_percent=-0.7),
        ),
        overlaps=_pairs(0.1, 0.3),
    )
    checks = {c.name: c for c in checks_against(Limits(), side)}
    assert (checks["bone off rigid"].place, checks["bone off rigid"].value) == ("b", 1.5)
    assert (checks["muscle volume change"].place, checks["muscle volume change"].value) == ("d", 0.7)
    assert checks["introduced overlap"].place == "a / b1"
    assert checks["introduced overlap"].value == pytest.approx(0.4, rel=1e-15)


def test_what_a_run_does_not_have_makes_no_check_and_is_told(make_side, make_tissue):
    side = make_side(mesh=None, tissues=(make_tissue("fat", "other", outside_skin_introduced_mm3=None),))
    names = {c.name for c in checks_against(Limits(), side)}
    assert not names & {"inverted tets", "bone off rigid", "muscle volume change", "introduced outside skin"}
    assert absent(side) == ("no bone", "no muscle", "no skin", "no tetrahedra")
    assert absent(make_side()) == ()


def test_totals_sum_over_pairs(make_side):
    side = make_side(
        overlaps=OverlapCheck((PairOverlap("a", "b", 1.0, 3.0, 2.0), PairOverlap("a", "c", 10.0, 10.5, 0.0)), 3, ())
    )
    total = side.overlap_total
    assert (total.rest_mm3, total.deformed_mm3, total.introduced_mm3) == (11.0, 13.5, 2.0)


def test_comparison_has_both_sides_and_leaves_out_what_neither_has(make_report, make_side):
    loop = make_side(mesh=None, steps=3)
    report = make_report(result=make_side(mesh=None), baseline=make_side(mesh=None, steps=1), paper_loop=loop)
    rows = {row.name: row for row in compare(report)}
    assert "inverted tets" not in rows
    cells = (rows["steps"].result, rows["steps"].paper_loop, rows["steps"].baseline)
    assert [cell.value for cell in cells] == [5.0, 3.0, 1.0]
    assert rows["muscle volume change"].limit == 1.0
    assert rows["muscle volume change, median"].result.passed is None
    assert all(row.baseline is None and row.paper_loop is None for row in compare(make_report()))
    half = {row.name: row for row in compare(make_report(baseline=make_side(mesh=None)))}
    assert half["inverted tets"].baseline.value is None
    assert half["inverted tets"].result.value == 0.0


def test_worst_tissues_come_first(make_tissue):
    tissues = (
        make_tissue("fine", "muscle", volume_change_percent=0.1),
        make_tissue("skin", "skin", volume_change_percent=50.0),
        make_tissue("thin", "muscle", volume_change_percent=-40.0),
        make_tissue("bent", "bone", rigidity_mm=3.0),
        make_tissue("unknown", "bone", rigidity_mm=None),
    )
    assert [t.name for t in worst_first(tissues, Limits())] == ["unknown", "bent", "thin", "fine", "skin"]
    strict = Limits(bone_rigidity_mm=0.0, muscle_volume_percent=0.0)
    assert [t.name for t in worst_first(tissues, strict)] == ["unknown", "thin", "bent", "fine", "skin"]


def _inspection(pairs=(), outside=0.0, not_checked=()):
    tissues = (
        TissueSummary("skin", "skin", 8, 12, 1000.0, None),
        TissueSummary("biceps", "muscle", 8, 12, 10.0, outside),
    )
    return MeshReport("arm", "mm", tissues, (), OverlapCheck(pairs, 1, not_checked))


def test_an_anatomy_passes_only_without_overlap_outside_or_unchecked_tissue():
    assert _inspection().verdict == "passed"
    overlapping = _inspection((PairOverlap("a", "b", 2.0, 2.0, 0.0),))
    assert _failed(overlapping) == {"overlap"}
    assert overlapping.overlap_total_mm3 == 2.0
    assert _failed(_inspection(outside=2.0)) == {"outside skin"}
    assert _failed(_inspection(outside=None)) == {"outside skin"}
    assert _failed(_inspection(not_checked=(NotChecked("a", "open"),))) == {"not checked"}
