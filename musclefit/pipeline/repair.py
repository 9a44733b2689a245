"""Dirty surfaces -> surfaces that bound solids and, where asked, share no point; orders the stages, opens no file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.repair.overlaps import resolved
from musclefit.anatomy.repair.records import RepairSettings
from musclefit.anatomy.repair.resolutions import Choice, Rule
from musclefit.anatomy.repair.surface import repair_surface
from musclefit.errors import InputError
from musclefit.geometry.arrays import Faces, Points, Tets
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.resurfacing import Fill
from musclefit.progress import Progress, Silent
from musclefit.report.repairs import RepairReport
from musclefit.validate.overlaps import rest_overlaps

ENVELOPE = 1.0 / 6.0
"""Share of the limit that a new surface may be off the old one's triangles."""

EDGE_FRACTION = 0.05
"""Edge length that new surfaces aim at, of the bounding box's diagonal; detail makes it shorter."""

Filler = Callable[[Points, Faces, float, float], tuple[Points, Tets]]
"""Vertices, faces, edge length and envelope as fractions of the diagonal -> vertices and tets around and inside."""


@dataclass(frozen=True, eq=False, slots=True)
class RawTissue:
    """A surface as it stands in its file: name, kind, mesh, and where it comes from, for messages."""

    name: str
    kind: TissueKind
    mesh: TriMesh
    source: str


@dataclass(frozen=True, eq=False, slots=True)
class RepairResult:
    """The report and the tissues, in the anatomy's order."""

    report: RepairReport
    anatomy: Anatomy


def repair(
    raw: Sequence[RawTissue],
    *,
    settings: RepairSettings,
    rule: Rule,
    filler: Filler | None,
    title: str,
    choice: Choice = Choice.LEAST_LOSS,
    findings: Sequence[Finding] = (),
    progress: Progress | None = None,
) -> RepairResult:
    """Repair each surface; then, by a rule, take away what two tissues share.

    Parameters
    ----------
    raw : sequence of RawTissue
    settings : RepairSettings
    rule : Rule
    filler : callable or None
        What tetrahedralises where local repair fails; None leaves that way out.
    title : str
    choice : Choice
    findings : sequence of Finding
        From reading the files.

    Raises
    ------
    MeshError
        A surface has no inside that could be found; see `anatomy.repair.repair_surface`.
    InputError
        A rule is to be used on a surface that could not be repaired, or would leave nothing of a tissue.
    """
    progress = progress or Silent()
    repaired = []
    with progress.stage("repair") as tick:
        for done, one in enumerate(raw, start=1):
            fill = None if filler is None else _fill(filler, one.mesh, settings)
            repaired.append(repair_surface(one.name, one.mesh, settings=settings, fill=fill, source=one.source))
            tick(done / len(raw))
    tissues = tuple(Tissue(one.name, one.kind, done.mesh) for one, done in zip(raw, repaired, strict=True))
    report = RepairReport(title, settings, Rule.NONE, choice, tuple(repaired), tuple(findings), None, None)
    mended = RepairResult(report, Anatomy(tissues, "as in the files"))
    return mended if rule is Rule.NONE else without_overlaps(mended, rule=rule, choice=choice, progress=progress)


def without_overlaps(
    mended: RepairResult, *, rule: Rule, choice: Choice = Choice.LEAST_LOSS, progress: Progress | None = None
) -> RepairResult:
    """Take away what two repaired tissues share, by a rule.

    Parameters
    ----------
    mended : RepairResult
        Of `repair` without a rule.
    rule : Rule
    choice : Choice
    progress : Progress, optional

    Raises
    ------
    InputError
        A surface that could not be repaired, or a rule that would leave nothing of a tissue.
    """
    progress, report = progress or Silent(), mended.report
    broken = [done for done in report.surfaces if not done.after.none]
    if broken:
        raise InputError(
            f"{broken[0].name}: could not be repaired ({broken[0].after.said()}), so its overlaps cannot be "
            "resolved; mend it in a mesh editor, leave it out, or run without --resolve"
        )
    resolution = resolved(mended.anatomy, rule=rule, settings=report.settings, progress=progress, choice=choice)
    overlaps = rest_overlaps(resolution.anatomy, progress=progress)
    told = replace(report, rule=rule, choice=choice, resolved=resolution, overlaps=overlaps)
    return RepairResult(told, resolution.anatomy)


def _fill(filler: Filler, mesh: TriMesh, settings: RepairSettings) -> Fill:
    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    envelope = min(max(ENVELOPE * settings.limit_mm / diagonal, 1e-6), 1e-2) if diagonal > 0.0 else 1e-3

    def fill(vertices: Points, faces: Faces) -> tuple[Points, Tets]:
        return filler(vertices, faces, EDGE_FRACTION, envelope)

    return fill
