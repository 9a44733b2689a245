"""Muscles in one pose: volume, centreline, largest cross-section, surface and smallest gap; judges nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.geometry.measures import area_vectors, enclosed_volume
from musclefit.geometry.queries.gaps import smallest_gap
from musclefit.geometry.surfaces.sections import Sections, sections_along
from musclefit.validate.overlaps import SolidAnatomy

NEAR_MM, FAR_MM = 1.0, 10.0
"""Neighbours are looked for within the first distance, and where there is none within the second."""


@dataclass(frozen=True, slots=True)
class MuscleMeasures:
    """One muscle in one pose.

    ``centreline_mm`` runs from end to end through the centres of the sections; ``largest_section_mm2`` is measured
    across it. ``gap_mm`` is the smallest distance to another tissue but the skin, ``neighbour`` that tissue: None where
    nothing is within ``FAR_MM``, or where a surface is not a solid.
    """

    name: str
    volume_mm3: float
    centreline_mm: float
    largest_section_mm2: float
    surface_mm2: float
    gap_mm: float | None
    neighbour: str | None


def muscle_sections(rest: Anatomy) -> Mapping[str, Sections]:
    """The sections of every muscle at rest, which ride along."""
    return {muscle.name: sections_along(muscle.surface) for muscle in rest.of_kind(TissueKind.MUSCLE)}


def measure_muscles(solids: SolidAnatomy, *, sections: Mapping[str, Sections]) -> tuple[MuscleMeasures, ...]:
    """Measure every muscle of an anatomy in one pose.

    Parameters
    ----------
    solids : SolidAnatomy
        The anatomy in its pose; a muscle's given vertices come first, as in the sections.
    sections : mapping of muscle name to Sections
        Of `muscle_sections`.
    """
    nearest = _nearest(solids)
    measures = []
    for muscle in solids.anatomy.of_kind(TissueKind.MUSCLE):
        along = sections[muscle.name].measure(muscle.surface.vertices)
        gap, neighbour = nearest.get(muscle.name, (None, None))
        measures.append(
            MuscleMeasures(
                name=muscle.name,
                volume_mm3=enclosed_volume(muscle.surface),
                centreline_mm=along.length,
                largest_section_mm2=along.largest_area,
                surface_mm2=float(np.linalg.norm(area_vectors(muscle.surface), axis=1).sum()),
                gap_mm=gap,
                neighbour=neighbour,
            )
        )
    return tuple(measures)


def _nearest(solids: SolidAnatomy) -> dict[str, tuple[float, str]]:
    """The smallest gap of each muscle to another tissue but the skin, and which that is; those without are left out.

    Each pair is looked at once, and only as far as it could be the smallest of one of the two.
    """
    names = [t.name for t in solids.anatomy if t.kind is not TissueKind.SKIN and t.name in solids.solids]
    muscles = {t.name for t in solids.anatomy.of_kind(TissueKind.MUSCLE)}
    found: dict[str, tuple[float, str]] = {}
    for within in (NEAR_MM, FAR_MM):
        open_ones = {name for name in names if name in muscles and name not in found}
        for one, other in combinations(names, 2):
            if not open_ones & {one, other}:
                continue
            reach = max(found.get(name, (within, ""))[0] for name in (one, other) if name in open_ones)
            gap = smallest_gap(solids.solids[one], solids.solids[other], within_mm=reach) if reach > 0.0 else np.inf
            for name, neighbour in ((one, other), (other, one)):
                if name in open_ones and gap < found.get(name, (within, ""))[0]:
                    found[name] = gap, neighbour
    return found
