"""What a repair found, changed and left: records that a report is made of; they mend nothing."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum

from musclefit.errors import InputError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.faults import Faults

MOST_CLEARANCE_MM = 2.0
"""Surfaces are grown along their normals by the clearance, which holds for less than their curvature's radius, mm."""


class Way(StrEnum):
    """How a surface was repaired."""

    UNTOUCHED = "untouched"
    LOCAL = "local"
    RESURFACED = "resurfaced"
    UNREPAIRED = "unrepaired"


@dataclass(frozen=True, slots=True)
class RepairSettings:
    """What a repair may do.

    Parameters
    ----------
    limit_mm : float
        How far the repaired surface may be from the original, either way, where there was surface.
    weld_mm : float
        Open edges are sewn together where their vertices are at most this far apart.
    stray_percent : float
        Pieces with less than this share of the surface's volume, or of its area where they are open, are taken out.
    thin_mm : float
        Closed pieces that are thinner than this on average (twice the volume over the area) are taken out.
    thicken_mm : float
        Thickness to give to an open sheet; 0 refuses it.
    clearance_mm : float
        Distance to leave between tissues where overlaps are taken away. A posed surface is followed within a chord
        tolerance of up to 0.05 mm on either side of a gap.
    max_change_percent : float
        Change of a tissue's volume, either way, beyond which the repair has failed.

    Raises
    ------
    InputError
        A value that is not finite, or below 0; a limit or a clearance of 0; a clearance beyond 2 mm.
    """

    limit_mm: float = 0.3
    weld_mm: float = 0.01
    stray_percent: float = 0.01
    thin_mm: float = 1e-3
    thicken_mm: float = 0.0
    clearance_mm: float = 0.1
    max_change_percent: float = 5.0

    def __post_init__(self) -> None:
        for own in fields(self):
            name, value = own.name, getattr(self, own.name)
            positive = name in ("limit_mm", "clearance_mm")
            if not 0.0 <= value < 1e6 or (positive and value == 0.0):
                raise InputError(f"{name} is {value}; give a number from 0 up" + ", above 0" * positive)
        if self.clearance_mm > MOST_CLEARANCE_MM:
            raise InputError(
                f"clearance_mm is {self.clearance_mm}; expected at most {MOST_CLEARANCE_MM:g}, which is what cutting "
                "can leave: shrink the tissues before"
            )

    @property
    def wall_mm(self) -> float:
        """Width below which walls and slots of a tissue that overlaps leave are taken out, mm: half the clearance."""
        return 0.5 * self.clearance_mm


@dataclass(frozen=True, slots=True)
class Change:
    """One kind of change to a surface: ``code`` is a short stable word, ``message`` says it with numbers.

    ``count`` counts what ``code`` names; area and volume are those of what was taken out or put in, 0 where neither.
    """

    code: str
    count: int
    message: str
    area_mm2: float = 0.0
    volume_mm3: float = 0.0


@dataclass(frozen=True, slots=True)
class Deviation:
    """How far a repaired surface is from the original, mm.

    Parameters
    ----------
    from_original_mm : float
        Largest distance found of the original from the result, without what the result encloses and what was dropped by
        name.
    to_original_mm : float
        Largest distance found of the result from the original and the patches over its holes.
    at_most_mm : float
        Proved upper bound of the two, with the same exceptions.
    whole_mm : float
        Upper bound, within 2 % or 0.05 mm, of the two-way Hausdorff distance without any exception.
    enclosed_mm2 : float
        Area of the original inside the result: walls and pieces that crossed.
    place_mm : (float, float, float)
        Where the larger of the first two occurs.
    """

    from_original_mm: float
    to_original_mm: float
    at_most_mm: float
    whole_mm: float
    enclosed_mm2: float
    place_mm: tuple[float, float, float]

    @property
    def largest_mm(self) -> float:
        """The two-way distance where there was surface, as far as it is proved."""
        return self.at_most_mm


UNCHANGED = Deviation(0.0, 0.0, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0))
"""Of a surface that was left as it is."""


@dataclass(frozen=True, eq=False, slots=True)
class Repaired:
    """One surface after repair.

    Parameters
    ----------
    name : str
    mesh : TriMesh
        The very same arrays as given where ``way`` is untouched.
    way : Way
    before, after : Faults
    changes : tuple of Change
        In the order in which they were made.
    deviation : Deviation
    volume_before_mm3, volume_after_mm3 : float
        Of an open surface, what its faces enclose with the origin of their middle.
    pieces_before, pieces_after : int
        Strays left out; before, hollows count, as a surface that bounds no solid does not tell them from bodies.
    limit_mm : float
    """

    name: str
    mesh: TriMesh
    way: Way
    before: Faults
    after: Faults
    changes: tuple[Change, ...]
    deviation: Deviation
    volume_before_mm3: float
    volume_after_mm3: float
    pieces_before: int
    pieces_after: int
    limit_mm: float

    @property
    def within_limit(self) -> bool:
        """Whether the surface stayed within the limit."""
        return self.deviation.largest_mm <= self.limit_mm

    @property
    def passed(self) -> bool:
        """Whether the surface bounds a solid and stayed within the limit."""
        return self.after.none and self.within_limit
