"""Muscles in one pose: volume, centreline, largest cross-section, surface and smallest gap; judges nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.geometry.gaps import smallest_gap
from musclefit.geometry.sections import Sections, sections_along
from musclefit.geometry.volumes import area_vectors, enclosed_volume
from musclefit.validate.overlaps import SolidAnatomy

NEAR_MM, FAR_MM = 1.0, 10.0
"""Neighbours are looked for within the first distance, and where there is none within the second."""


@dataclass(frozen=True, slots=True)
class MuscleMeasures:
    """One muscle in one pose.

    ``centreline_mm`` runs from end to end through the centres of the sections; ``largest_section_mm2`` is measured
    across it. ``gap_mm`` is the smallest distance to another tissue but the skin, ``neighbour`` that tissue: None where
    nothing is within ``FAR_MM``, or where a surface is no solid.
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
    measures = []
    for muscle in solids.anatomy.of_kind(TissueKind.MUSCLE):
        along = sections[muscle.name].measure(muscle.surface.vertices)
        gap, neighbour = _nearest(solids, muscle.name)
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


def _nearest(solids: SolidAnatomy, name: str) -> tuple[float, str] | tuple[None, None]:
    """The smallest gap of a tissue to another but the skin, and which that is."""
    if name not in solids.solids:
        return None, None
    own = solids.solids[name]
    others = [t.name for t in solids.anatomy if t.kind is not TissueKind.SKIN and t.name != name]
    for within in (NEAR_MM, FAR_MM):
        best, which = within, ""
        for other in others:
            if other in solids.solids:
                gap = smallest_gap(own, solids.solids[other], within_mm=best)
                if gap < best:
                    best, which = gap, other
            if math.isclose(best, 0.0, abs_tol=1e-12):
                break
        if which:
            return best, which
    return None, None
