"""Turns a report into JSON values, every number finite or null, with the JSON Schema that documents the keys."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from musclefit.progress import CERTIFY, MARCH
from musclefit.report import document as doc
from musclefit.report.model import (
    SCHEMA_VERSION,
    MeshReport,
    Report,
    Side,
    TetSummary,
    checks_against,
    verdict_of,
)
from musclefit.rig.settings import Limits
from musclefit.validate.bones import RESOLUTION_DEG, STEP_DEG
from musclefit.validate.joint_ranges import JointRange
from musclefit.validate.model import MESH_SURFACES, MESH_THEOREM, BoneFieldCheck, MeshCheck, MeshRefinement
from musclefit.vocabulary import Claim

Json = dict[str, Any]


def report_schema() -> Json:
    """JSON Schema of ``report.json`` as written by a run."""
    return doc.schema_of(doc.RunDocument, "Report of one musclefit run")


def mesh_report_schema() -> Json:
    """JSON Schema of the report of an anatomy as it is."""
    return doc.schema_of(doc.InspectionDocument, "Report of one musclefit inspection")


def joint_range_schema() -> Json:
    """JSON Schema of one coordinate's free range, all others at rest."""
    return doc.schema_of(doc.JointRange, "Free range of one coordinate")


def to_json(report: Report | MeshReport) -> Json:
    """The report as JSON values, as documented by ``report_schema`` or ``mesh_report_schema``.

    Numbers that are not finite become null; their checks have failed already.

    Raises
    ------
    TypeError
        The provenance holds something that has no JSON form; names its key.
    """
    return (_inspection(report) if isinstance(report, MeshReport) else _run(report)).values()


def side_to_json(side: Side, limits: Limits) -> Json:
    """One method's outcome as JSON values: the keys of ``report_schema`` that tell of the result."""
    return _outcome(side, limits).values()


def joint_ranges_to_json(ranges: Sequence[JointRange]) -> list[Json]:
    """How far joints can turn, as JSON values: the items of ``joint_ranges`` in ``report_schema``."""
    return [_joint_range(found).values() for found in ranges]


def _run(report: Report) -> doc.RunDocument:
    limits = report.limits
    return doc.RunDocument.of(
        report,
        **dict(_outcome(report.result, limits)),
        schema_version=SCHEMA_VERSION,
        limits=doc.Limits.of(limits, because=report.purpose_because),
        tets=None if report.tets is None else _tets(report.tets),
        joint_ranges=[_joint_range(found) for found in report.joint_ranges],
        baseline=None if report.baseline is None else _outcome(report.baseline, limits),
        paper_loop=None if report.paper_loop is None else _outcome(report.paper_loop, limits),
        certificate_cost=_certificate_cost(report.timings_s),
    )


def _inspection(report: MeshReport) -> doc.InspectionDocument:
    found = report.overlaps
    return doc.InspectionDocument.of(
        report,
        schema_version=SCHEMA_VERSION,
        overlaps=[doc.SharedVolume.of(pair, volume_mm3=pair.rest_mm3) for pair in found.pairs],
        pairs_tested=found.pairs_tested,
        not_checked=found.not_checked,
    )


def _outcome(side: Side, limits: Limits) -> doc.Outcome:
    checks = checks_against(limits, side)
    return doc.Outcome.of(
        side,
        verdict=verdict_of(checks),
        mesh=None if side.mesh is None else _mesh(side.mesh),
        bones=None if side.bones is None else _bones(side.bones),
        overlaps=side.overlaps.pairs,
        bone_overlaps=side.overlaps.bones,
        pairs_tested=side.overlaps.pairs_tested,
        not_checked=side.overlaps.not_checked,
        checks=checks,
    )


def _bones(found: BoneFieldCheck) -> doc.Bones:
    residual = doc.FieldResidual(p99=found.residual_p99_mm, max=found.residual_max_mm)
    return doc.Bones.of(found, field_residual_mm=residual)


def _mesh(found: MeshCheck) -> doc.Mesh:
    return doc.Mesh.of(
        found,
        theorem=MESH_THEOREM if found.claim is Claim.CERTIFIED else "",
        surfaces=MESH_SURFACES,
        refinement=None if found.refinement is None else _refinement(found.refinement),
    )


def _refinement(found: MeshRefinement) -> doc.Refinement:
    return doc.Refinement.of(found, left_out=doc.LeftOut(tets=found.left_out, volume_mm3=found.left_out_mm3))


def _tets(found: TetSummary) -> doc.Tets:
    space = doc.LeftOut(tets=found.joint_space_tets, volume_mm3=found.joint_space_mm3)
    return doc.Tets.of(found, joint_space=space)


def _joint_range(found: JointRange) -> doc.JointRange:
    return doc.JointRange.of(found, joint=found.coordinate, step_deg=STEP_DEG, resolution_deg=RESOLUTION_DEG)


def _certificate_cost(seconds: Mapping[str, float]) -> doc.CertificateCost | None:
    """What the proof of the map took beside the deformation that it is about."""
    if MARCH not in seconds or CERTIFY not in seconds:
        return None
    march, proof = seconds[MARCH], seconds[CERTIFY]
    share = proof / march if march > 0.0 else math.inf
    return doc.CertificateCost(certificate_s=proof, deformation_s=march, share=share)
