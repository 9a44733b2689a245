"""How overlaps were taken away: rules and records that a report is made of; they cut nothing."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from musclefit.anatomy.model import Anatomy
from musclefit.anatomy.repair.records import Change
from musclefit.geometry.surfaces.faults import Faults


class Rule(StrEnum):
    """What becomes of what two tissues share.

    ``NONE`` leaves it shared, ``PRIORITY`` gives it to one of them, ``SPLIT`` parts it between two of one kind where
    both are equally deep.
    """

    NONE = "none"
    PRIORITY = "priority"
    SPLIT = "split"


class Choice(StrEnum):
    """Whom priority gives it to: bone before muscle before other and, within a kind, by this.

    ``LEAST_LOSS`` cuts the one that loses the smaller share of itself, ``SMALLER`` the larger of the two. ``ANY_KIND``
    is least loss whatever the kinds.
    """

    LEAST_LOSS = "least-loss"
    SMALLER = "smaller"
    ANY_KIND = "any-kind"


@dataclass(frozen=True, slots=True)
class PairResolution:
    """One overlapping pair.

    ``overlap_mm3`` is what the two shared; ``a`` lost ``from_a_mm3`` of it and ``b`` the rest. ``rule`` says why.
    """

    a: str
    b: str
    rule: str
    overlap_mm3: float
    from_a_mm3: float
    from_b_mm3: float


@dataclass(frozen=True, slots=True)
class TissueCut:
    """One tissue that was cut.

    Parameters
    ----------
    name : str
    volume_before_mm3, volume_after_mm3 : float
    pieces_before, pieces_after : int
        Hollows left out.
    clearance_mm : float
        The distance that was cut around the others; 0 where only thin places of its own were taken out.
    changes : tuple of Change
        What was tidied.
    after : Faults
    """

    name: str
    volume_before_mm3: float
    volume_after_mm3: float
    pieces_before: int
    pieces_after: int
    clearance_mm: float
    changes: tuple[Change, ...]
    after: Faults

    @property
    def change_percent(self) -> float:
        """Of its volume, negative where it was lost."""
        return 100.0 * (self.volume_after_mm3 / self.volume_before_mm3 - 1.0)


@dataclass(frozen=True, slots=True)
class Gap:
    """Two tissues that stand nearer to each other than the clearance, and how near."""

    a: str
    b: str
    gap_mm: float


@dataclass(frozen=True, slots=True)
class ThinTissue:
    """A tissue that is still closer to itself than half the clearance: over what area, both sides counted."""

    name: str
    area_mm2: float


@dataclass(frozen=True, eq=False, slots=True)
class Resolved:
    """An anatomy without overlaps, or with those that are ``left``.

    Parameters
    ----------
    anatomy : Anatomy
        Tissues that nothing was taken from are the very same.
    pairs : tuple of PairResolution
        Largest overlap first.
    cuts : tuple of TissueCut
    left : tuple of (name, name)
        Pairs that still meet.
    clearance_mm : float
        The clearance that was aimed at.
    gaps : tuple of Gap
        Pairs that are apart by less, smallest gap first.
    thin : tuple of ThinTissue
    """

    anatomy: Anatomy
    pairs: tuple[PairResolution, ...]
    cuts: tuple[TissueCut, ...]
    left: tuple[tuple[str, str], ...]
    clearance_mm: float
    gaps: tuple[Gap, ...]
    thin: tuple[ThinTissue, ...]
