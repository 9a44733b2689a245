"""Thin walls, narrow slots and small gaps: where surfaces of an anatomy come closer than a stated length."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import TissueKind
from musclefit.geometry.arrays import Bool
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.queries.gaps import smallest_gap
from musclefit.geometry.queries.solids import candidate_pairs
from musclefit.geometry.surfaces.thin_walls import ThinPlaces, thin_places
from musclefit.progress import Progress, Tick
from musclefit.validate.overlaps import SolidAnatomy

THIN, SLOT, GAP = "thin-wall", "narrow-slot", "small-gap"
CLOSE = (THIN, SLOT, GAP)
"""Codes of the findings."""


def close_findings(
    solids: SolidAnatomy, *, thinnest_mm: float, smallest_gap_mm: float, progress: Progress
) -> tuple[Finding, ...]:
    """Where tissues are thinner, their slots narrower, or the gaps between two of them smaller than stated.

    Walls and slots are sampled at the middles of small triangles; gaps are exact between the triangles of pairs that do
    not overlap, the skin left out. What is not a solid is not looked at.

    Parameters
    ----------
    solids : SolidAnatomy
    thinnest_mm, smallest_gap_mm : float
        0 switches this off.
    """
    found: list[Finding] = []
    tissues = [tissue for tissue in solids.anatomy if tissue.name in solids.solids]
    with progress.stage("close places") as tick:
        for number, tissue in enumerate(tissues):
            if thinnest_mm > 0.0:
                places = thin_places(tissue.surface, width_mm=thinnest_mm)
                found += _thin(tissue.name, places, places.wall, THIN, f"is thinner than {thinnest_mm:g} mm")
                slot = f"has slots narrower than {thinnest_mm:g} mm"
                found += _thin(tissue.name, places, places.slot, SLOT, slot)
            tick((number + 1) / len(tissues))
    if smallest_gap_mm > 0.0:
        names = [tissue.name for tissue in tissues if tissue.kind is not TissueKind.SKIN]
        with progress.stage("gaps") as tick:
            found += _gaps(solids, names, smallest_gap_mm, tick)
    return tuple(found)


def _thin(name: str, places: ThinPlaces, where: Bool, code: str, said: str) -> Iterator[Finding]:
    if not where.any():
        return
    areas = np.linalg.norm(area_vectors(places.mesh), axis=1)
    largest = int(np.argmax(np.where(where, areas, -1.0)))
    at = ", ".join(f"{x:.2f}" for x in places.mesh.corners()[largest].mean(axis=0))
    yield Finding(name, code, f"{name} {said} over {areas[where].sum():.3g} mm² of its surface, such as at ({at}) mm")


def _gaps(solids: SolidAnatomy, names: list[str], within_mm: float, tick: Tick) -> Iterator[Finding]:
    margin = np.array([[-0.5], [0.5]]) * within_mm
    boxes = [solids.solids[name].box + margin for name in names]
    pairs = candidate_pairs(boxes).tolist()
    for number, (i, j) in enumerate(pairs):
        a, b = names[i], names[j]
        gap = smallest_gap(solids.solids[a], solids.solids[b], within_mm=within_mm)
        tick((number + 1) / len(pairs))
        if 0.0 < gap < within_mm:
            yield Finding(f"{a} and {b}", GAP, f"{a} and {b} are {gap:.3g} mm apart, closer than {within_mm:g} mm")
