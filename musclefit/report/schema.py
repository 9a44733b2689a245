"""Turns a report into JSON values, every number finite or null, with the JSON Schema that documents the keys."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.mesh_fidelity import TissueFit
from musclefit.progress import CERTIFY, MARCH
from musclefit.report.json_schema import mesh_report_schema, report_schema
from musclefit.report.model import (
    SCHEMA_VERSION,
    MeshReport,
    Report,
    Side,
    TetSummary,
    TissueSummary,
    checks_against,
    total_overlap,
    verdict_of,
)
from musclefit.rig.settings import Limits
from musclefit.validate.bones import RESOLUTION_DEG, STEP_DEG
from musclefit.validate.joint_ranges import JointRange, RangeEnd
from musclefit.validate.model import (
    MESH_SURFACES,
    MESH_THEOREM,
    BoneFieldCheck,
    BoneOverlap,
    Check,
    MapCheck,
    MeshCheck,
    MeshRefinement,
    NotChecked,
    PairOverlap,
    TissueCheck,
    WorstTet,
)
from musclefit.vocabulary import Claim

__all__ = ["Json", "mesh_report_schema", "report_schema", "to_json"]

Json = dict[str, Any]


def to_json(report: Report | MeshReport) -> Json:
    """The report as JSON values, as documented by ``report_schema`` or ``mesh_report_schema``.

    Numbers that are not finite become null; their checks have failed already.

    Raises
    ------
    TypeError
        The provenance holds something that has no JSON form; names its key.
    """
    if isinstance(report, MeshReport):
        return _inspection(report)
    return {
        "schema_version": SCHEMA_VERSION,
        "title": report.title,
        **_side(report.result, report.limits),
        "limits": _limits(report),
        "tets": None if report.tets is None else _tets(report.tets),
        "joint_ranges": joint_ranges_to_json(report.joint_ranges),
        "findings": [_finding(f) for f in report.findings],
        "baseline": None if report.baseline is None else _side(report.baseline, report.limits),
        "paper_loop": None if report.paper_loop is None else _side(report.paper_loop, report.limits),
        "timings_s": {name: _number(seconds) for name, seconds in report.timings_s.items()},
        "certificate_cost": _certificate_cost(report.timings_s),
        "peak_memory_mb": _number(report.peak_memory_mb),
        "provenance": _plain(report.provenance, "provenance"),
    }


def _limits(report: Report) -> Json:
    """What the result is held against, and why these."""
    limits = report.limits
    numbers: Json = {name: _number(value) for name, value in limits.numbers.items()}
    numbers["inverted_tets"] = int(limits.inverted_tets)
    return {"purpose": limits.purpose.value, "because": report.purpose_because, **numbers}


def _certificate_cost(seconds: Mapping[str, float]) -> Json | None:
    """What the proof of the map took beside the deformation that it is about."""
    if MARCH not in seconds or CERTIFY not in seconds:
        return None
    march, proof = seconds[MARCH], seconds[CERTIFY]
    share = proof / march if march > 0.0 else math.inf
    return {"certificate_s": _number(proof), "deformation_s": _number(march), "share": _number(share)}


def side_to_json(side: Side, limits: Limits) -> Json:
    """One method's outcome as JSON values: the keys of ``report_schema`` that tell of the result."""
    return _side(side, limits)


def joint_ranges_to_json(ranges: Sequence[JointRange]) -> list[Json]:
    """How far joints can turn, as JSON values: the items of ``joint_ranges`` in ``report_schema``."""
    return [
        {
            "joint": found.coordinate,
            "low": _range_end(found.low),
            "high": _range_end(found.high),
            "limits_deg": [_number(limit) for limit in found.limits_deg],
            "step_deg": STEP_DEG,
            "resolution_deg": RESOLUTION_DEG,
            "untested": list(found.untested),
        }
        for found in ranges
    ]


def _range_end(end: RangeEnd) -> Json:
    return {
        "degrees": _number(end.degrees),
        "ended_by": end.ended_by,
        "beyond": None if end.beyond is None else _bone_overlap(end.beyond),
    }


def _bone_overlap(found: BoneOverlap) -> Json:
    return {
        "a": found.a,
        "b": found.b,
        "rest_mm3": _number(found.rest_mm3),
        "posed_mm3": _number(found.posed_mm3),
        "beyond_mm3": _number(found.beyond_mm3),
        "beyond_limit_mm3": _number(found.beyond_limit_mm3),
        "depth_mm": _number(found.depth_mm),
        "depth_limit_mm": _number(found.depth_limit_mm),
    }


def _inspection(report: MeshReport) -> Json:
    return {
        "schema_version": SCHEMA_VERSION,
        "title": report.title,
        "verdict": report.verdict,
        "frame": report.frame,
        "tissues": [_tissue_summary(t) for t in report.tissues],
        "overlaps": [{"a": p.a, "b": p.b, "volume_mm3": _number(p.rest_mm3)} for p in report.overlaps.pairs],
        "overlap_total_mm3": _number(report.overlap_total_mm3),
        "pairs_tested": int(report.overlaps.pairs_tested),
        "not_checked": [_not_checked(n) for n in report.overlaps.not_checked],
        "findings": [_finding(f) for f in report.findings],
        "checks": [_check(c) for c in report.checks],
        "timings_s": {name: _number(seconds) for name, seconds in report.timings_s.items()},
        "peak_memory_mb": _number(report.peak_memory_mb),
        "provenance": _plain(report.provenance, "provenance"),
    }


def _side(side: Side, limits: Limits) -> Json:
    checks = checks_against(limits, side)
    total = total_overlap(side.overlaps.pairs)
    return {
        "verdict": verdict_of(checks),
        "status": side.status,
        "steps": int(side.steps),
        "method": side.method,
        "landmarks": {
            "count": int(side.landmarks.count),
            "max_error_mm": _number(side.landmarks.max_error_mm),
            "worst": side.landmarks.worst,
        },
        "map": _map(side.map),
        "mesh": None if side.mesh is None else _mesh(side.mesh),
        "steps_rejected": int(side.steps_rejected),
        "edges_split": int(side.edges_split),
        "edges_left_bent": int(side.edges_left_bent),
        "crossings_left": int(side.crossings_left),
        "steps_returned": int(side.steps_returned),
        "bones": None if side.bones is None else _bones(side.bones),
        "tissues": [_tissue(t) for t in side.tissues],
        "overlaps": [_pair(p) for p in side.overlaps.pairs],
        "overlap_total": {
            "rest_mm3": _number(total.rest_mm3),
            "deformed_mm3": _number(total.deformed_mm3),
            "introduced_mm3": _number(total.introduced_mm3),
        },
        "bone_overlaps": [_bone_overlap(overlap) for overlap in side.overlaps.bones],
        "pairs_tested": int(side.overlaps.pairs_tested),
        "not_checked": [_not_checked(n) for n in side.overlaps.not_checked],
        "checks": [_check(c) for c in checks],
    }


def _map(found: MapCheck) -> Json:
    return {
        "claim": found.claim.value,
        "rule": found.rule,
        "margin": _number(found.margin),
        "points_tested": int(found.points_tested),
        "folded_points": int(found.folded_points),
        "min_jacobian_determinant": _number(found.min_jacobian_determinant),
        "place_mm": [_number(x) for x in found.place_mm],
        "boxes_examined": int(found.boxes_examined),
        "boxes_left": int(found.boxes_left),
        "gap_mm": None if found.gap_mm is None else _number(found.gap_mm),
        "not_covered": list(found.not_covered),
    }


def _bones(found: BoneFieldCheck) -> Json:
    return {
        "contact_zone_mm": _number(found.contact_zone_mm),
        "exposed_vertices": int(found.exposed_vertices),
        "exposed_samples": int(found.exposed_samples),
        "gap_mm": None if found.gap_mm is None else _number(found.gap_mm),
        "contact_vertices": int(found.contact_vertices),
        "field_residual_mm": {"p99": _number(found.residual_p99_mm), "max": _number(found.residual_max_mm)},
        "contact_residual_max_mm": _number(found.contact_residual_max_mm),
    }


def _mesh(found: MeshCheck) -> Json:
    return {
        "tets": int(found.tets),
        "inverted": int(found.inverted),
        "min_volume_ratio": _number(found.min_volume_ratio),
        "max_volume_ratio": _number(found.max_volume_ratio),
        "claim": found.claim.value,
        "inverted_by_tissue": [{"name": name, "inverted": int(count)} for name, count in found.inverted_by_tissue],
        "theorem": MESH_THEOREM if found.claim is Claim.CERTIFIED else "",
        "surfaces": MESH_SURFACES,
        "note": found.note,
        "boundary_faces": int(found.boundary_faces),
        "crossings": int(found.crossings),
        "crossing_tissues": [{"a": a, "b": b, "crossings": int(count)} for a, b, count in found.crossing_tissues],
        "worst": [_worst_tet(tet) for tet in found.worst],
        "straight_fraction": _number(found.straight_fraction),
        "refinement": None if found.refinement is None else _refinement(found.refinement),
    }


def _worst_tet(found: WorstTet) -> Json:
    return {
        "tet": int(found.tet),
        "tissue": found.tissue,
        "rest_place_mm": [_number(x) for x in found.rest_place_mm],
        "place_mm": [_number(x) for x in found.place_mm],
        "volume_ratio": _number(found.volume_ratio),
    }


def _refinement(found: MeshRefinement) -> Json:
    return {
        "rounds": int(found.rounds),
        "edges_split": int(found.edges_split),
        "tets_before": int(found.tets_before),
        "inverted_before": int(found.inverted_before),
        "crossings_before": int(found.crossings_before),
        "cut_by_tissue": [{"name": name, "cut": int(count)} for name, count in found.cut_by_tissue],
        "stopped": found.stopped,
        "moving_rounds": int(found.moving_rounds),
        "moved_aside": [
            {"name": name, "vertices": int(count), "farthest_mm": _number(far)}
            for name, count, far in found.moved_aside
        ],
        "left_out": {"tets": int(found.left_out), "volume_mm3": _number(found.left_out_mm3)},
    }


def _tets(found: TetSummary) -> Json:
    return {
        "tets": int(found.tets),
        "vertices": int(found.vertices),
        "left_out": int(found.left_out),
        "turned": int(found.turned),
        "joint_space": {"tets": int(found.joint_space_tets), "volume_mm3": _number(found.joint_space_mm3)},
        "tissues": [_fit(fit) for fit in found.tissues],
    }


def _fit(found: TissueFit) -> Json:
    return {
        "name": found.name,
        "kind": found.kind,
        "tets": int(found.tets),
        "volume_mm3": _number(found.volume_mm3),
        "surface_mm3": _number(found.surface_mm3),
        "inside_mm3": _number(found.inside_mm3),
        "volume_error_percent": _number(found.volume_error_percent),
        "yielded_mm3": _number(found.yielded_mm3),
        "envelope_mm": _number(found.envelope_mm),
        "off_mm": _number(found.off_mm),
        "missed_mm": _number(found.missed_mm),
        "pieces": found.pieces,
        "surface_pieces": found.surface_pieces,
        "alone": int(found.alone),
    }


def _tissue(found: TissueCheck) -> Json:
    return {
        "name": found.name,
        "kind": str(found.kind),
        "rest_volume_mm3": _number(found.rest_volume_mm3),
        "volume_mm3": _number(found.volume_mm3),
        "volume_change_percent": _number(found.volume_change_percent),
        "rigidity_mm": _number(found.rigidity_mm),
        "rigidity_reference": found.rigidity_reference,
        "outside_skin_rest_mm3": _number(found.outside_skin_rest_mm3),
        "outside_skin_mm3": _number(found.outside_skin_mm3),
        "outside_skin_introduced_mm3": _number(found.outside_skin_introduced_mm3),
    }


def _tissue_summary(found: TissueSummary) -> Json:
    return {
        "name": found.name,
        "kind": str(found.kind),
        "vertices": int(found.vertices),
        "triangles": int(found.triangles),
        "volume_mm3": _number(found.volume_mm3),
        "outside_skin_mm3": _number(found.outside_skin_mm3),
    }


def _pair(found: PairOverlap) -> Json:
    return {
        "a": found.a,
        "b": found.b,
        "rest_mm3": _number(found.rest_mm3),
        "deformed_mm3": _number(found.deformed_mm3),
        "introduced_mm3": _number(found.introduced_mm3),
    }


def _not_checked(left: NotChecked) -> Json:
    return {"what": left.what, "reason": left.reason}


def _finding(found: Finding) -> Json:
    return {"subject": found.subject, "code": found.code, "message": found.message}


def _check(check: Check) -> Json:
    return {
        "name": check.name,
        "value": _number(check.value),
        "limit": _number(check.limit),
        "unit": check.unit,
        "place": check.place,
        "passed": bool(check.passed),
        "next_step": check.next_step,
    }


def _number(value: float | None) -> float | None:
    """The number, or None where JSON has no form for it."""
    return None if value is None or not math.isfinite(value) else float(value)


def _plain(value: object, key: str) -> Any:
    """The value in JSON's own types."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, Mapping):
        return {str(k): _plain(v, f"{key}.{k}") for k, v in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, bytes | bytearray):
        return [_plain(v, f"{key}[{i}]") for i, v in enumerate(value)]
    raise TypeError(
        f"{key} is a {type(value).__name__}; give text, numbers, booleans, None, lists or mappings of these"
    )
