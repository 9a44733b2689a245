"""The JSON: valid by its own schema, every number finite or null, every documented key there."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import jsonschema
import numpy as np
import pytest

from musclefit.report.model import MeshReport, TissueSummary
from musclefit.report.schema import mesh_report_schema, report_schema, to_json
from musclefit.validate.joint_ranges import JointRange, RangeEnd
from musclefit.validate.model import BoneOverlap, NotChecked, OverlapCheck, PairOverlap

TOUCHING = BoneOverlap("humerus", "ulna", 0.0, 0.5, 0.5, 0.2, 100.0, 0.6)
ELBOW = JointRange("elbow", RangeEnd(-5.0, "limit"), RangeEnd(120.0, "bones", TOUCHING), (-5.0, math.inf), ("fibula",))


def _validate(values, schema):
    jsonschema.Draft202012Validator.check_schema(schema)
    text = json.dumps(values, allow_nan=False)
    jsonschema.Draft202012Validator(schema).validate(json.loads(text))


def test_reports_are_valid_by_their_schema(make_report, make_side):
    for report in (
        make_report(),
        make_report(baseline=make_side(status="stalled"), paper_loop=make_side(steps=9)),
        make_report(result=make_side(mesh=None)),
        make_report(result=make_side(overlaps=OverlapCheck((), 3, (), (TOUCHING,))), joint_ranges=(ELBOW,)),
    ):
        _validate(to_json(report), report_schema())


def test_the_promised_keys_are_there(make_report, make_side):
    found = to_json(make_report(baseline=make_side(status="stalled")))
    assert found["schema_version"] == 1
    assert (found["title"], found["verdict"], found["status"], found["steps"]) == ("Arm", "passed", "converged", 5)
    assert found["landmarks"]["count"] == 35
    assert found["map"]["claim"] == "sampled"
    assert set(found["mesh"]) >= {"tets", "inverted", "min_volume_ratio", "claim"}
    assert set(found["tissues"][1]) >= {
        "name",
        "kind",
        "rest_volume_mm3",
        "volume_mm3",
        "volume_change_percent",
        "rigidity_mm",
        "outside_skin_mm3",
    }
    pair = {"a": "biceps", "b": "humerus", "rest_mm3": 2.0, "deformed_mm3": 2.5, "introduced_mm3": 0.25}
    assert found["overlaps"] == [pair]
    assert found["overlap_total"] == {"rest_mm3": 2.0, "deformed_mm3": 2.5, "introduced_mm3": 0.25}
    assert set(found["checks"][0]) == {"name", "value", "limit", "unit", "place", "passed", "next_step"}
    assert found["baseline"]["verdict"] == "failed"
    assert found["paper_loop"] is None
    looped = to_json(make_report(paper_loop=make_side(steps=9)))["paper_loop"]
    assert (looped["steps"], set(looped)) == (9, set(found["baseline"]))
    assert set(found["baseline"]) == set(found) - {
        "schema_version",
        "title",
        "findings",
        "baseline",
        "paper_loop",
        "certificate_cost",
        "joint_ranges",
        "limits",
        "tets",
        "timings_s",
        "peak_memory_mb",
        "provenance",
    }
    assert found["provenance"]["settings"] == {"pose": [["elbow", 75.0]], "tets": True}


def test_the_certificate_costs_what_its_stage_took_beside_the_march(make_report):
    found = to_json(make_report(timings_s={"march": 4.0, "certify the map": 1.0, "read": 9.0}))
    assert found["certificate_cost"] == {"certificate_s": 1.0, "deformation_s": 4.0, "share": 0.25}
    _validate(found, report_schema())
    assert to_json(make_report(timings_s={"march": 4.0}))["certificate_cost"] is None


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_become_null_and_fail(bad, make_report, make_side, make_tissue):
    side = make_side(
        map=replace(make_side().map, min_jacobian_determinant=bad, margin=bad, place_mm=(bad, bad, bad)),
        tissues=(make_tissue("m", "muscle", volume_change_percent=bad, volume_mm3=bad),),
        overlaps=OverlapCheck((PairOverlap("a", "b", bad, bad, bad),), 1, ()),
    )
    report = make_report(result=side, peak_memory_mb=bad, timings_s={"x": bad}, provenance={"x": [bad]})
    found = to_json(report)
    _validate(found, report_schema())
    assert found["verdict"] == "failed"
    assert found["map"]["margin"] is None
    assert found["overlap_total"]["introduced_mm3"] is None
    assert found["provenance"] == {"x": [None]}
    failed = [c for c in found["checks"] if not c["passed"]]
    overlap = "introduced overlap" if bad == -math.inf else "grown overlap"  # a rest overlap below 0 is none
    assert {c["name"] for c in failed} == {"folded points", "muscle volume change", overlap}
    assert all(c["value"] is None for c in failed)


def test_the_verdict_in_json_is_that_of_its_checks(make_report, make_side):
    for report in (make_report(), make_report(result=make_side(status="stalled"))):
        found = to_json(report)
        assert (found["verdict"] == "passed") == all(c["passed"] for c in found["checks"])


def test_the_schema_refuses_a_missing_and_an_unknown_key(make_report):
    found = to_json(make_report())
    validator = jsonschema.Draft202012Validator(report_schema())
    assert not validator.is_valid({k: v for k, v in found.items() if k != "overlap_total"})
    assert not validator.is_valid({**found, "colour": "red"})
    assert not validator.is_valid({**found, "map": {**found["map"], "claim": "proved"}})


@pytest.mark.parametrize("schema", [report_schema(), mesh_report_schema()], ids=["run", "inspection"])
def test_every_key_of_the_schema_is_described(schema):
    assert schema["$schema"].endswith("2020-12/schema")
    for name, part in {"": schema, **schema["$defs"]}.items():
        assert part.get("description") or "enum" in part, name
        for key, value in part.get("properties", {}).items():
            described = schema["$defs"][value["$ref"].rpartition("/")[2]] if "$ref" in value else {}
            assert value.get("description") or described.get("description"), f"{name}.{key} has no description"


def test_provenance_without_a_json_form_is_named(make_report):
    with pytest.raises(TypeError, match=r"provenance\.a\.b is a ndarray"):
        to_json(make_report(provenance={"a": {"b": np.zeros(2)}}))


def test_counts_of_numpy_are_plain_integers(make_report, make_side):
    side = make_side(map=replace(make_side().map, folded_points=np.int64(3)), steps=np.int64(2))
    _validate(to_json(make_report(result=side)), report_schema())


def test_inspections_are_valid_by_their_schema():
    tissues = (TissueSummary("skin", "skin", 8, 12, 1000.0, None), TissueSummary("b", "bone", 8, 12, math.nan, 0.0))
    overlaps = OverlapCheck((PairOverlap("skin", "b", 2.0, 2.0, 0.0),), 1, (NotChecked("b", "open"),))
    report = MeshReport("arm", "mm", tissues, (), overlaps)
    found = to_json(report)
    _validate(found, mesh_report_schema())
    assert found["overlaps"] == [{"a": "skin", "b": "b", "volume_mm3": 2.0}]
    assert found["verdict"] == "failed"


def test_joint_ranges_and_touching_bones_are_written_with_their_limits(make_report, make_side):
    found = to_json(make_report(result=make_side(overlaps=OverlapCheck((), 3, (), (TOUCHING,))), joint_ranges=(ELBOW,)))
    assert found["bone_overlaps"][0] == {
        "a": "humerus",
        "b": "ulna",
        "rest_mm3": 0.0,
        "posed_mm3": 0.5,
        "beyond_mm3": 0.5,
        "beyond_limit_mm3": 100.0,
        "depth_mm": 0.2,
        "depth_limit_mm": 0.6,
    }
    (elbow,) = found["joint_ranges"]
    assert elbow["limits_deg"] == [-5.0, None]
    assert elbow["low"] == {"degrees": -5.0, "ended_by": "limit", "beyond": None}
    assert elbow["high"]["beyond"] == found["bone_overlaps"][0]
    assert elbow["untested"] == ["fibula"]
