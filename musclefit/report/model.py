"""What one run or one inspection found, as a value; sums up what was measured, computes no geometry, knows no file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from musclefit.anatomy.findings import Finding, some_of
from musclefit.anatomy.mesh_fidelity import TissueFit
from musclefit.anatomy.model import TissueKind
from musclefit.geometry.queries.solids import ROUNDING_MM3
from musclefit.report import next_steps
from musclefit.rig.settings import Limits
from musclefit.validate.joint_ranges import JointRange
from musclefit.validate.model import (
    BoneFieldCheck,
    Check,
    LandmarkCheck,
    MapCheck,
    MeshCheck,
    NotChecked,
    OverlapCheck,
    PairOverlap,
    TissueCheck,
)
from musclefit.validate.tissues import PRESCRIBED
from musclefit.vocabulary import Claim, Purpose

SCHEMA_VERSION = 1
"""Version of the report's JSON; raised whenever a key changes its meaning or goes away."""

CONVERGED = "converged"
"""The status of a run whose landmarks all arrived; every other text says how it ended early."""

KEEPS_VOLUME = "isochoric"
"""What the words for a method hold whose kernel keeps volume."""

_FREE = {"bone_rigidity_mm": "the bending of free bones", "muscle_volume_percent": "the volume of muscles"}
"""Limits that a purpose may leave out, in words."""

Verdict = Literal["passed", "failed"]


@dataclass(frozen=True, slots=True)
class OverlapTotal:
    """Overlap volumes summed over all pairs, mm³."""

    rest_mm3: float
    deformed_mm3: float
    introduced_mm3: float


@dataclass(frozen=True, slots=True)
class Side:
    """The outcome of one method on one anatomy.

    Parameters
    ----------
    method : str
        The method in words, for example "iterative RBF (Yu et al. 2014), r2logr, row-norm at all points".
    status : str
        ``CONVERGED``, or how the run ended instead, in words; anything but ``CONVERGED`` fails the run.
    steps : int
    landmarks, map, tissues, overlaps
        What was measured.
    mesh : MeshCheck or None
        None where no tetrahedra were made.
    steps_rejected : int
        Stretches of the path that were tried and cut shorter.
    edges_split, edges_left_bent : int
        Edges of the surfaces that were split because the map bends them, and those still bent beyond the tolerance.
    crossings_left : int
        Pairs of triangles that come to cross though the map does not fold, and that halving does not part.
    steps_returned : int
        Times that the march was taken back to a step because points between those tested needed a shorter one.
    bones : BoneFieldCheck or None
        None where bones are not held rigid.
    """

    method: str
    status: str
    steps: int
    landmarks: LandmarkCheck
    map: MapCheck
    mesh: MeshCheck | None
    tissues: tuple[TissueCheck, ...]
    overlaps: OverlapCheck
    steps_rejected: int = 0
    edges_split: int = 0
    edges_left_bent: int = 0
    crossings_left: int = 0
    steps_returned: int = 0
    bones: BoneFieldCheck | None = None

    @property
    def overlap_total(self) -> OverlapTotal:
        """Overlap volumes summed over all pairs."""
        return total_overlap(self.overlaps.pairs)

    def of_kind(self, kind: TissueKind) -> tuple[TissueCheck, ...]:
        """The tissues of one kind, in order."""
        return tuple(t for t in self.tissues if t.kind == kind)


@dataclass(frozen=True, slots=True)
class TetSummary:
    """The tetrahedra at rest, held against the surfaces they were made from.

    Parameters
    ----------
    tets, vertices : int
    left_out : int
        Tets made that lie in no tissue.
    turned : int
        Tets that came left-handed and had two corners swapped.
    joint_space_tets, joint_space_mm3
        Filler between sliding bones that was left out.
    tissues : tuple of TissueFit
        The filler among them.
    """

    tets: int
    vertices: int
    left_out: int
    turned: int
    joint_space_tets: int
    joint_space_mm3: float
    tissues: tuple[TissueFit, ...]


@dataclass(frozen=True, eq=False, slots=True)
class Report:
    """One run: the result, what it is compared with, and whether it keeps its limits.

    Parameters
    ----------
    title : str
    result : Side
    baseline : Side or None
        A method to compare with on the same input, or None where none was run; it never changes the verdict.
    findings : tuple of Finding
        What was found in the input; shown, but no part of the verdict.
    limits : Limits
    paper_loop : Side or None
        The same handles by the loop of Yu et al. 2014; None where the result is that loop's, or it was not wanted. It
        never changes the verdict.
    purpose_because : str
        Why the limits are for the purpose that they name.
    timings_s : mapping of stage name to seconds
    peak_memory_mb : float
    provenance : mapping
        Versions, hashes of the input, settings: text, numbers, booleans, None, and lists and mappings of these.
    tets : TetSummary or None
        None where no tetrahedra were made.
    joint_ranges : tuple of JointRange
        How far the joints that the pose turns can turn, each by itself; shown, but no part of the verdict.
    """

    title: str
    result: Side
    baseline: Side | None
    findings: tuple[Finding, ...]
    limits: Limits
    timings_s: Mapping[str, float]
    peak_memory_mb: float
    provenance: Mapping[str, Any]
    tets: TetSummary | None = None
    joint_ranges: tuple[JointRange, ...] = ()
    purpose_because: str = ""
    paper_loop: Side | None = None

    @property
    def limits_in_words(self) -> str:
        """What the limits are for, why, and what has none."""
        purpose = {Purpose.POSING: "for another pose", Purpose.ANOTHER_BODY: "for another body"}[self.limits.purpose]
        because = f", because {self.purpose_because}" if self.purpose_because else ""
        free = [name for name, value in self.limits.numbers.items() if value is None]
        none = f"; no limit on {' and '.join(_FREE[name] for name in free)}" if free else ""
        return f"{purpose}{because}{none}"

    @property
    def checks(self) -> tuple[Check, ...]:
        """The result held against the limits."""
        return checks_against(self.limits, self.result)

    @property
    def verdict(self) -> Verdict:
        """Passed when every check of the result passed."""
        return verdict_of(self.checks)


@dataclass(frozen=True, slots=True)
class TissueSummary:
    """One tissue as it is; ``outside_skin_mm3`` is None where there is no skin, and for the skin itself."""

    name: str
    kind: str
    vertices: int
    triangles: int
    volume_mm3: float
    outside_skin_mm3: float | None


@dataclass(frozen=True, slots=True)
class MeshLimits:
    """What an anatomy as it is must keep to pass an inspection."""

    overlap_mm3: float = 1.0
    outside_skin_mm3: float = 1.0


@dataclass(frozen=True, eq=False, slots=True)
class MeshReport:
    """One inspection of an anatomy as it is.

    ``overlaps`` holds the pairs at rest: ``rest_mm3`` and ``deformed_mm3`` are equal and nothing is introduced.
    Findings of the codes in ``fail_on`` fail it; others are shown and do not change the verdict. What makes a tissue
    unusable is in ``overlaps.not_checked``.
    """

    title: str
    frame: str
    tissues: tuple[TissueSummary, ...]
    findings: tuple[Finding, ...]
    overlaps: OverlapCheck
    limits: MeshLimits = field(default_factory=MeshLimits)
    fail_on: tuple[str, ...] = ()
    timings_s: Mapping[str, float] = field(default_factory=dict)
    peak_memory_mb: float = math.nan
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def overlap_total_mm3(self) -> float:
        """Overlap volume summed over all pairs, mm³."""
        return total_overlap(self.overlaps.pairs).rest_mm3

    @property
    def checks(self) -> tuple[Check, ...]:
        """The anatomy held against its limits."""
        shared = [(_pair(p), _volume(p.rest_mm3)) for p in self.overlaps.pairs]
        checks = [_total("overlap", shared, self.limits.overlap_mm3, next_step=next_steps.REST_OVERLAP)]
        if any(t.kind == TissueKind.SKIN for t in self.tissues):
            outside = [(t.name, _volume(t.outside_skin_mm3)) for t in self.tissues if t.kind != TissueKind.SKIN]
            limit = self.limits.outside_skin_mm3
            checks.append(_total("outside skin", outside, limit, next_step=next_steps.REST_OUT_OF_SKIN))
        for code in self.fail_on:
            found = [finding.subject for finding in self.findings if finding.code == code]
            place = some_of(found, most=3)
            checks.append(
                Check(code, float(len(found)), 0.0, "findings", place, next_step=next_steps.after_findings(code))
            )
        unusable = any(finding.code == "unusable" for finding in self.findings)
        checked = _all_checked(self.overlaps.not_checked)
        return (*checks, replace(checked, next_step=next_steps.REST_UNUSABLE) if unusable else checked)

    @property
    def verdict(self) -> Verdict:
        """Passed when every check passed."""
        return verdict_of(self.checks)


def verdict_of(checks: Iterable[Check]) -> Verdict:
    """Passed when every check passed."""
    return "passed" if all(check.passed for check in checks) else "failed"


def total_overlap(pairs: Iterable[PairOverlap]) -> OverlapTotal:
    """Overlap volumes summed over pairs; one that is not a volume makes the sum NaN."""
    pairs = tuple(pairs)
    return OverlapTotal(
        rest_mm3=math.fsum(_volume(p.rest_mm3) for p in pairs),
        deformed_mm3=math.fsum(_volume(p.deformed_mm3) for p in pairs),
        introduced_mm3=math.fsum(_volume(p.introduced_mm3) for p in pairs),
    )


def checks_against(limits: Limits, side: Side) -> tuple[Check, ...]:
    """Hold what was measured against the limits.

    A number that is missing or not finite becomes NaN and fails; so does anything that could not be checked. What the
    run does not have at all (no bone, no muscle, no skin, no tetrahedra) makes no check: see ``absent``.

    Parameters
    ----------
    limits : Limits
    side : Side

    Returns
    -------
    tuple of Check
        Each passes when its value is a number at or below its limit.
    """
    bones, muscles = side.of_kind(TissueKind.BONE), side.of_kind(TissueKind.MUSCLE)
    ended = side.status == CONVERGED
    late = next_steps.LANDMARKS_MISSED if ended else next_steps.LANDMARKS_LATE
    checks = [
        Check("not converged", float(not ended), 0.0, "", side.status, next_step=next_steps.after_ending(side.status)),
        Check(
            "landmark error",
            _finite(side.landmarks.max_error_mm),
            limits.landmark_mm,
            "mm",
            side.landmarks.worst,
            next_step=late,
        ),
        *_map_checks(side.map),
    ]
    if side.mesh is not None:
        checks += _mesh_checks(side.mesh, limits)
    if bones:
        checks += _bone_checks(side, bones, limits)
    if muscles:
        changes = [(t.name, abs(_measured(t.volume_change_percent))) for t in muscles]
        step = next_steps.MUSCLES_CHANGE if _are_driven(bones) else next_steps.MUSCLES_CHANGE_FREELY
        step = next_steps.MUSCLES_STILL_CHANGE if KEEPS_VOLUME in side.method else step
        limit = _or_none(limits.muscle_volume_percent)
        checks.append(_worst("muscle volume change", changes, limit, unit="%", next_step=step))
    apart, riding = _by_rest(side.overlaps.pairs)
    checks.append(_total("introduced overlap", apart, limits.introduced_overlap_mm3, next_step=next_steps.NEW_OVERLAP))
    if riding:
        checks.append(_total("grown overlap", riding, limits.grown_overlap_mm3, next_step=next_steps.MORE_OVERLAP))
    if side.of_kind(TissueKind.SKIN):
        inside = [t for t in side.tissues if t.kind != TissueKind.SKIN]
        outside = [(t.name, _volume(t.outside_skin_introduced_mm3)) for t in inside]
        limit = limits.introduced_outside_skin_mm3
        checks.append(_total("introduced outside skin", outside, limit, next_step=next_steps.OUT_OF_SKIN))
    return (*checks, _all_checked(side.overlaps.not_checked))


def bone_limit(side: Side, bone: TissueCheck, limits: Limits) -> float:
    """How far a bone may be off rigid; infinite where nothing limits it."""
    if limits.bone_rigidity_mm is not None:
        return limits.bone_rigidity_mm
    return limits.held_rigidity_mm if _is_held(side, bone) else math.inf


def _are_driven(bones: tuple[TissueCheck, ...]) -> bool:
    """Whether something says how bones move."""
    return any(bone.rigidity_reference == PRESCRIBED for bone in bones)


def _is_held(side: Side, bone: TissueCheck) -> bool:
    return side.bones is not None and bone.rigidity_reference == PRESCRIBED


def _bone_checks(side: Side, bones: tuple[TissueCheck, ...], limits: Limits) -> list[Check]:
    """How far bones are off a rigid motion; where others have no limit, those that are held or kept have theirs."""
    step = next_steps.BONES_BEND if _are_driven(bones) else next_steps.BONES_BEND_FREELY
    step = next_steps.BONES_LEFT_OUT if side.bones is not None else step
    by_limit: dict[float, list[tuple[str, float]]] = {}
    for bone in bones:
        by_limit.setdefault(bone_limit(side, bone, limits), []).append((bone.name, _measured(bone.rigidity_mm)))
    names = ("bone off rigid", "free bone off rigid")  # the second only where the first has a limit and others none
    return [
        _worst(name, by_limit[limit], limit, unit="mm", next_step=step)
        for name, limit in zip(names, sorted(by_limit), strict=False)
    ]


def absent(side: Side) -> tuple[str, ...]:
    """What the run does not have, and which therefore has no check."""
    kinds = {t.kind for t in side.tissues}
    told = [f"no {kind.value}" for kind in (TissueKind.BONE, TissueKind.MUSCLE, TissueKind.SKIN) if kind not in kinds]
    return (*told, *(["no tetrahedra"] if side.mesh is None else []))


def _map_checks(found: MapCheck) -> list[Check]:
    """No tested point folded, and no fold proved; points that were never tested, or a determinant of NaN, fail."""
    smallest = found.min_jacobian_determinant
    tested = found.points_tested > 0 and (found.folded_points > 0 or (math.isfinite(smallest) and smallest > 0))
    place = "at rest: ({:.4g}, {:.4g}, {:.4g}) mm".format(*found.place_mm) if found.folded_points else ""
    refuted = found.claim is Claim.REFUTED
    return [
        Check(
            "folded points",
            float(found.folded_points) if tested else math.nan,
            0.0,
            "points",
            place,
            next_step=next_steps.FOLDED,
        ),
        Check("map refuted", float(refuted), 0.0, "", found.rule if refuted else "", next_step=next_steps.REFUTED),
        *_coverage(found),
    ]


def _coverage(found: MapCheck) -> list[Check]:
    """A certified map speaks of everything that is delivered; no check where nothing is claimed or left out."""
    left = found.not_covered
    if found.claim is not Claim.CERTIFIED or not left:
        return []
    return [Check("outside the proof", float(len(left)), 0.0, "files", left[0], next_step=next_steps.NOT_COVERED)]


def _mesh_checks(found: MeshCheck, limits: Limits) -> list[Check]:
    """Inverted tets within their limit, and no refutation for any other cause than those."""
    smallest = found.min_volume_ratio
    measured = found.tets > 0 and (found.inverted > 0 or (math.isfinite(smallest) and smallest > 0))
    worst = max(found.inverted_by_tissue, key=lambda item: item[1], default=("", 0))[0]
    other_cause = found.claim is Claim.REFUTED and found.inverted == 0
    cause = found.note if other_cause else ""
    return [
        Check(
            "inverted tets",
            float(found.inverted) if measured else math.nan,
            float(limits.inverted_tets),
            "tets",
            worst,
            next_step=next_steps.after_inverted_tets(found),
        ),
        Check("mesh refuted", float(other_cause), 0.0, "", cause, next_step=next_steps.MESH_REFUTED),
    ]


def _all_checked(left: tuple[NotChecked, ...]) -> Check:
    place = left[0].what if left else ""
    return Check("not checked", float(len(left)), 0.0, "items", place, next_step=next_steps.UNCHECKED)


def _worst(name: str, values: list[tuple[str, float]], limit: float, *, unit: str, next_step: str) -> Check:
    """The largest of named values; one that is not a number is worse than any number."""
    place, value = max(values, key=lambda item: math.inf if math.isnan(item[1]) else item[1])
    return Check(name, value, limit, unit, place, next_step=next_step)


def _total(name: str, volumes: list[tuple[str, float]], limit: float, *, next_step: str) -> Check:
    """The sum of named volumes, mm³, placed at the largest."""
    total = math.fsum(volume for _, volume in volumes)
    place, largest = max(volumes, key=lambda item: math.inf if math.isnan(item[1]) else item[1], default=("", 0.0))
    return Check(name, total, limit, "mm³", "" if largest == 0 else place, next_step=next_step)


def _by_rest(pairs: Iterable[PairOverlap]) -> tuple[list[tuple[str, float]], list[tuple[str, float]]]:
    """What is introduced between pairs that were apart at rest, and between those that overlapped already."""
    split: tuple[list[tuple[str, float]], list[tuple[str, float]]] = ([], [])
    for pair in pairs:
        split[not pair.rest_mm3 <= ROUNDING_MM3].append((_pair(pair), _volume(pair.introduced_mm3)))
    return split


def _pair(pair: PairOverlap) -> str:
    return f"{pair.a} / {pair.b}"


def _measured(value: float | None) -> float:
    """The value, or NaN where it is missing or not finite."""
    return math.nan if value is None else _finite(value)


def _volume(value: float | None) -> float:
    """An overlap volume, or NaN where it is missing, not finite or negative (a surface turned inside out)."""
    return value if value is not None and math.isfinite(value) and value >= 0 else math.nan


def _or_none(limit: float | None) -> float:
    """The limit, or one that no number breaks."""
    return math.inf if limit is None else limit


def _finite(value: float) -> float:
    return value if math.isfinite(value) else math.nan
