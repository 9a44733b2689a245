"""An anatomy as it is: overlaps at rest, tissue outside the skin, findings; nothing is moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.geometry.arrays import Gradients, Points
from musclefit.geometry.measures import enclosed_volume
from musclefit.progress import Progress, Silent
from musclefit.report.model import MeshReport, TissueSummary
from musclefit.report.next_steps import with_next_steps
from musclefit.validate.closeness import close_findings
from musclefit.validate.overlaps import check_outside_skin, rest_overlaps, solid_anatomy


def inspect(
    anatomy: Anatomy,
    *,
    findings: Sequence[Finding],
    title: str,
    thinnest_mm: float = 0.0,
    smallest_gap_mm: float = 0.0,
    progress: Progress | None = None,
) -> MeshReport:
    """Report an anatomy as it stands.

    Parameters
    ----------
    anatomy : Anatomy
    findings : sequence of Finding
        What was found when reading it.
    title : str
    thinnest_mm, smallest_gap_mm : float
        Thinner walls, narrower slots and smaller gaps are findings; 0 switches this off.

    Returns
    -------
    MeshReport
    """
    progress = progress or Silent()
    solids = solid_anatomy(anatomy, progress=progress)
    overlaps = rest_overlaps(solids, progress=progress)
    outside = check_outside_skin(solids, solids, mapped=_same, progress=progress)
    close: tuple[Finding, ...] = ()
    if thinnest_mm > 0.0 or smallest_gap_mm > 0.0:
        close = close_findings(solids, thinnest_mm=thinnest_mm, smallest_gap_mm=smallest_gap_mm, progress=progress)
    beyond = {tissue.name: tissue.rest_mm3 for tissue in outside.tissues}
    tissues = tuple(
        TissueSummary(
            name=tissue.name,
            kind=tissue.kind.value,
            vertices=len(tissue.surface.vertices),
            triangles=len(tissue.surface.faces),
            volume_mm3=enclosed_volume(tissue.surface),
            outside_skin_mm3=beyond.get(tissue.name),
        )
        for tissue in anatomy
    )
    return MeshReport(
        title=title,
        frame=anatomy.frame,
        tissues=tissues,
        findings=with_next_steps((*findings, *close)),
        overlaps=replace(overlaps, not_checked=(*overlaps.not_checked, *outside.not_checked)),
    )


def _same(points: Points) -> tuple[Points, Gradients]:
    """Nothing moves."""
    return points, np.broadcast_to(np.eye(3), (len(points), 3, 3))
