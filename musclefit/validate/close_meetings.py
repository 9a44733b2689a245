"""Do two tissues whose given triangles meet between frames really meet? Finer triangles at poses in between decide.

Given triangles that move straight from frame to frame are coarse twice: in space, where the map bends them, and in
time, where joints turn. So a meeting that is seen of them is looked at with triangles that are split where the map
bends them, at poses on the way: each pose by volume (exact booleans), each stretch from one to the next by continuous
collision detection. What is cleared that way was looked at, not proved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise
from typing import Protocol

from musclefit.anatomy.model import Anatomy
from musclefit.errors import MusclefitError
from musclefit.geometry.queries.solids import ROUNDING_MM3
from musclefit.geometry.surfaces.crossings import crossings_between
from musclefit.progress import Silent
from musclefit.validate.between_frames import Passage, check_passages, shared_volume
from musclefit.validate.carried_volumes import Mapped
from musclefit.validate.overlaps import check_overlaps

FINEST = 2
"""How often triangles are made finer before an overlap that stays is believed."""

ROUNDS = 6
"""How often it is looked again, with finer triangles or at more poses; in the last, stretches are 1/64 of the way."""

SHRINKS = 0.5
"""An overlap is believed where the finest triangles leave more than this share of what coarser ones showed: those of
half the edge and a quarter of the chord tolerance take most of it away where it comes of triangles alone."""

Names = tuple[str, str]


class MeetingKind(StrEnum):
    """What a meeting that is seen of given triangles turns out to be."""

    TOUCHES = "touching at the start"
    GRAZE = "graze of coarse triangles"
    ENTERS = "enters"
    LEAVES = "leaves"
    THROUGH = "passes through"
    UNSETTLED = "not settled"

    @property
    def fails(self) -> bool:
        """Whether tissues pass through each other, or that could not be ruled out.

        What enters or leaves is seen in a frame, and judged there.
        """
        return self in (MeetingKind.THROUGH, MeetingKind.UNSETTLED)


@dataclass(frozen=True, eq=False, slots=True)
class Posed:
    """Two tissues in one pose, and the map of space that took them there from rest."""

    anatomy: Anatomy
    mapped: Mapped


@dataclass(frozen=True, eq=False, slots=True)
class Refined:
    """Two tissues on the same fine triangles at rest and in some poses.

    Parameters
    ----------
    rest : Anatomy
    posed : tuple of Posed
        In order of time.
    chord_mm, longest_mm : float
        How far the middle of an edge may be off the map, and how long an edge may be.
    """

    rest: Anatomy
    posed: tuple[Posed, ...]
    chord_mm: float
    longest_mm: float


class PosesBetween(Protocol):
    """Who can say where two tissues are between two frames."""

    def can_make(self, moments: Sequence[float]) -> bool:
        """Whether the poses at these fractions of the way are there already or may still be made."""
        ...

    def refined(self, names: Names, moments: Sequence[float], *, fineness: int) -> Refined:
        """Two tissues at fractions of the way, 0 and 1 included; the higher the fineness, the finer the triangles.

        Raises
        ------
        MusclefitError
            A pose on the way cannot be made.
        """
        ...


@dataclass(frozen=True, slots=True)
class Look:
    """What was found by looking closer.

    Parameters
    ----------
    kind : MeetingKind
    poses : int
        On the way that were looked at, both frames not counted; 0 where it was not looked at closer.
    chord_mm, longest_mm : float
        Of the finest triangles; NaN where it was not looked at closer.
    triangles : int
        Of both tissues, the finest.
    most_overlap_mm3 : float
        The largest overlap introduced in any of these poses or in a frame; NaN where it is not known.
    note : str
        What else there is to say, in words.
    """

    kind: MeetingKind
    poses: int = 0
    chord_mm: float = math.nan
    longest_mm: float = math.nan
    triangles: int = 0
    most_overlap_mm3: float = math.nan
    note: str = ""


@dataclass(frozen=True, slots=True)
class _Seen:
    """Two tissues on some triangles: overlap introduced in each pose, which stretches meet, if they touch first."""

    introduced: tuple[float, ...]
    meets: tuple[bool, ...]
    touching: bool

    @property
    def overlaps(self) -> tuple[bool, ...]:
        """In which poses they overlap by more than rounding."""
        return tuple(volume > ROUNDING_MM3 for volume in self.introduced)

    @property
    def most(self) -> float:
        """The largest overlap introduced in a pose, mm³; 0 where none is known."""
        return max((volume for volume in self.introduced if not math.isnan(volume)), default=0.0)


def told_by_frames(passage: Passage, rest: Anatomy) -> Look | None:
    """What a meeting of given triangles is where no pose on the way is needed to tell; None where one is.

    Parameters
    ----------
    passage : Passage
    rest : Anatomy
        The given triangles at rest.

    Returns
    -------
    Look or None
        "touching at the start" where the tissues overlap in the first frame or at rest, or touch in the first frame and
        come to meet nowhere else on the way.
    """
    if passage.overlap_before_mm3 > ROUNDING_MM3:
        return Look(MeetingKind.TOUCHES, note="overlapping in the frame before")
    if passage.touching and not passage.further:
        return Look(MeetingKind.TOUCHES, note="in the frame before, and meeting nowhere else")
    if shared_volume(rest, passage.a, passage.b) > ROUNDING_MM3:
        return Look(MeetingKind.TOUCHES, note="overlapping at rest")
    return None


def looked_at(passage: Passage, rest: Anatomy, poses: PosesBetween) -> Look:
    """What a meeting of given triangles turns out to be; looked at closer where the frames do not tell.

    Tissues that touch at rest touch in every pose, so that triangles always meet: where nothing worse is found, they
    are "touching at the start", and the note says what was not settled.

    Parameters
    ----------
    passage : Passage
    rest : Anatomy
        The given triangles at rest.
    poses : PosesBetween
    """
    told = told_by_frames(passage, rest)
    if told is not None:
        return told
    names = (passage.a, passage.b)
    look = look_closer(names, poses)
    if look.kind is not MeetingKind.UNSETTLED or not look.triangles:
        return look
    if not len(crossings_between(*(rest[name].surface for name in names))):
        return look
    return replace(look, kind=MeetingKind.TOUCHES, note=f"touching at rest; {look.note}")


def look_closer(names: Names, poses: PosesBetween) -> Look:
    """Look at two tissues between two frames with finer triangles, at more and more poses on the way.

    Parameters
    ----------
    names : tuple of str
    poses : PosesBetween

    Returns
    -------
    Look
        "graze of coarse triangles" where finer ones share nothing in any pose and meet on no straight stretch from one
        to the next; "enters", "leaves" and "passes through" where even the finest overlap, and hardly less than coarser
        ones; "not settled" where neither was found with the poses that may be made.

    Notes
    -----
    Between poses next to each other vertices move straight again; that is sampled evidence. Stretches that meet are
    halved where no pose shows an overlap; where one does, triangles are made finer.
    """
    moments: list[float] = [0.0, 0.5, 1.0]
    looked: tuple[Refined, _Seen] | None = None
    coarser = 0.0
    reason = "no pose on the way may be made any more"
    for number in range(ROUNDS):
        fineness = min(number, FINEST)
        if poses.can_make(moments):
            try:
                refined = poses.refined(names, moments, fineness=fineness)
            except MusclefitError as error:
                reason = str(error)
                break
            seen = _seen(names, refined)
            looked = refined, seen
            if not any(seen.overlaps) and not any(seen.meets):
                kind = MeetingKind.TOUCHES if seen.touching else MeetingKind.GRAZE
                return _look(kind, refined, seen, note=_doubt(seen))
            if any(seen.overlaps) and fineness == FINEST:
                if math.isinf(seen.most) or seen.most > SHRINKS * coarser:
                    return _look(_confirmed(seen), refined, seen)
                reason = f"an overlap that shrinks from {coarser:.3g} to {seen.most:.3g} mm³ as triangles get finer"
                break
            coarser = seen.most
            reason = "triangles still meet on the way, from " + _in_words(moments, seen)
            wanted = _halved(moments, seen)
            if poses.can_make(wanted):
                moments = wanted
            elif fineness == FINEST:
                break
        else:
            break
    if looked is None:
        return Look(MeetingKind.UNSETTLED, note=reason)
    return _look(MeetingKind.UNSETTLED, *looked, note=reason)


def _in_words(moments: Sequence[float], seen: _Seen) -> str:
    met = [f"{a:.4g} to {b:.4g}" for (a, b), meets in zip(pairwise(moments), seen.meets, strict=True) if meets]
    return f"{', '.join(met)} of it" if met else "an overlap in a pose"


def _halved(moments: Sequence[float], seen: _Seen) -> list[float]:
    """The moments, and the middles of stretches that meet."""
    more = [0.5 * (a + b) for (a, b), meets in zip(pairwise(moments), seen.meets, strict=True) if meets]
    return sorted({*moments, *more})


def _confirmed(seen: _Seen) -> MeetingKind:
    """What an overlap of the finest triangles is, by the frames that show it."""
    first, last = seen.overlaps[0], seen.overlaps[-1]
    if first:
        return MeetingKind.TOUCHES if last else MeetingKind.LEAVES
    return MeetingKind.ENTERS if last else MeetingKind.THROUGH


def _seen(names: Names, refined: Refined) -> _Seen:
    """Stretches are examined only where no pose shows an overlap: that decides alone."""
    introduced = tuple(_introduced(names, refined.rest, posed) for posed in refined.posed)
    if any(volume > ROUNDING_MM3 for volume in introduced):
        return _Seen(introduced, (False,) * (len(introduced) - 1), False)
    stretches = [_meeting(a.anatomy, b.anatomy) for a, b in pairwise(refined.posed)]
    first = stretches[0]
    return _Seen(
        introduced,
        tuple(met is not None and met.further for met in stretches),
        first is not None and first.touching,
    )


def _meeting(before: Anatomy, after: Anatomy) -> Passage | None:
    found = check_passages(before, after, progress=Silent()).passages
    return found[0] if found else None


def _introduced(names: Names, rest: Anatomy, posed: Posed) -> float:
    """What two tissues share in a pose beyond what they did at rest, mm³.

    Where a surface is not a solid, infinite where triangles cross or touch and did not at rest, else NaN.
    """
    at_rest, now = shared_volume(rest, *names), shared_volume(posed.anatomy, *names)
    if math.isnan(at_rest) or math.isnan(now):
        crossing = [len(crossings_between(*(a[name].surface for name in names))) for a in (rest, posed.anatomy)]
        return math.inf if crossing[1] and not crossing[0] else math.nan
    if at_rest <= ROUNDING_MM3:
        return now
    found = check_overlaps(rest, posed.anatomy, mapped=posed.mapped, progress=Silent()).pairs
    return max((pair.introduced_mm3 for pair in found), default=0.0)


def _doubt(seen: _Seen) -> str:
    return (
        "a surface is not a solid: tested for crossings, not for volumes"
        if any(map(math.isnan, seen.introduced))
        else ""
    )


def _look(kind: MeetingKind, refined: Refined, seen: _Seen, *, note: str = "") -> Look:
    known = [volume for volume in seen.introduced if not math.isnan(volume)]
    return Look(
        kind=kind,
        poses=len(refined.posed) - 2,
        chord_mm=refined.chord_mm,
        longest_mm=refined.longest_mm,
        triangles=sum(len(tissue.surface.faces) for tissue in refined.rest),
        most_overlap_mm3=max(known, default=math.nan),
        note=note,
    )
