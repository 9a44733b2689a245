"""A sequence as a value: frames, what lies between them, and whether all keep the limits; knows no file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from musclefit.anatomy.findings import Finding
from musclefit.report import next_steps
from musclefit.report.model import Verdict, verdict_of
from musclefit.validate.between_frames import Passage
from musclefit.validate.close_meetings import Look, MeetingKind
from musclefit.validate.model import Check
from musclefit.validate.muscles import MuscleMeasures
from musclefit.vocabulary import Claim

SEQUENCE_SCHEMA_VERSION = 2

REST_MM = 1e-9
"""How far a frame in the rest pose may be from rest."""

MADE, REFUSED, FAILED = "made", "refused", "failed"


@dataclass(frozen=True, slots=True)
class FrameSummary:
    """One frame.

    Parameters
    ----------
    number, time_s, pose_deg
    outcome : str
        "made"; "refused" where bones collide; "failed" where the method does not get there.
    problem : str
        Why it was not made, in words.
    checks : tuple of Check
        As in the report of a single run; none where it was not made.
    claim : str
        What is known of the map.
    steps : int
    method : str
    off_rest_mm : float or None
        In the rest pose, how far from rest; None in other poses.
    overlap_mm3 : float
        Introduced, over all pairs.
    overlaps : tuple of (a, b, mm³)
        Pairs with introduced overlap, largest first.
    muscles : tuple of MuscleMeasures
    volume_changes : mapping of muscle name to percent
    cpu_s : mapping of part to seconds
        ``frame`` in all, and its ``march``: what it took to find the deformation.
    """

    number: int
    time_s: float
    pose_deg: Mapping[str, float]
    outcome: str
    problem: str
    checks: tuple[Check, ...]
    claim: str
    steps: int
    method: str
    off_rest_mm: float | None
    overlap_mm3: float
    overlaps: tuple[tuple[str, str, float], ...]
    muscles: tuple[MuscleMeasures, ...]
    volume_changes: Mapping[str, float]
    cpu_s: Mapping[str, float]

    @property
    def verdict(self) -> Verdict:
        """Passed when it was made and every check passed."""
        return verdict_of(self.checks) if self.outcome == MADE else "failed"


@dataclass(frozen=True, slots=True)
class PassageSummary:
    """Two tissues whose given triangles meet between two frames, and what that turned out to be.

    Parameters
    ----------
    a, b : str
    time_s : float
        When they are first seen to meet.
    overlap_before_mm3, overlap_after_mm3 : float
        Of the given triangles in the two frames.
    kind : str
        A `MeetingKind`.
    poses : int
        On the way that were looked at with finer triangles, the frames not counted; 0 where it was not looked closer.
    chord_mm, longest_mm : float
        Chord tolerance and longest edge at rest of the finest triangles; NaN where it was not looked closer.
    triangles : int
        Of both tissues, the finest.
    most_overlap_mm3 : float
        The largest overlap introduced in a pose that was looked at.
    note : str
    """

    a: str
    b: str
    time_s: float
    overlap_before_mm3: float
    overlap_after_mm3: float
    kind: str
    poses: int = 0
    chord_mm: float = math.nan
    longest_mm: float = math.nan
    triangles: int = 0
    most_overlap_mm3: float = math.nan
    note: str = ""

    @classmethod
    def of(cls, passage: Passage, look: Look, *, time_s: float) -> PassageSummary:
        """What is told of a meeting."""
        said = {**asdict(look), "kind": look.kind.value}
        return cls(passage.a, passage.b, time_s, passage.overlap_before_mm3, passage.overlap_after_mm3, **said)

    @property
    def looked_closer(self) -> str:
        """How it was looked at closer, in words; "" where it was not."""
        if not self.triangles:
            return ""
        return (
            f"{self.poses} poses on the way, {self.triangles} triangles, edges up to {self.longest_mm:.3g} mm, chord "
            f"tolerance {self.chord_mm:.3g} mm, overlap up to {self.most_overlap_mm3:.3g} mm³"
        )


@dataclass(frozen=True, slots=True)
class BetweenSummary:
    """What happens from one frame to the next: pairs whose given triangles meet, and what that turned out to be.

    ``problem`` says why it was not examined, in words.
    """

    first: int
    second: int
    passages: tuple[PassageSummary, ...] = ()
    pairs_examined: int = 0
    problem: str = ""
    cpu_s: float = 0.0

    @property
    def proved_free(self) -> bool:
        """Whether it is proved that no given triangles of two tissues meet, each vertex moving straight."""
        return not self.passages and not self.problem

    def of_kind(self, kind: MeetingKind) -> tuple[PassageSummary, ...]:
        """The meetings of one kind."""
        return tuple(passage for passage in self.passages if passage.kind == kind.value)


@dataclass(frozen=True, eq=False, slots=True)
class SequenceReport:
    """A motion from its first to its last frame.

    Parameters
    ----------
    title : str
    resampling : str
        How frames were made of keyframes, in words.
    frames : tuple of FrameSummary
    between : tuple of BetweenSummary
        One for each pair of consecutive frames; empty where that was not asked for.
    limits : mapping of limit to value
        None for no limit.
    cpu_s : mapping of part to seconds
        Summed over all processes, of this run.
    provenance : mapping
    findings : tuple of Finding
        What was found in the input; none of it fails a sequence.
    """

    title: str
    resampling: str
    frames: tuple[FrameSummary, ...]
    between: tuple[BetweenSummary, ...]
    limits: Mapping[str, float | None]
    cpu_s: Mapping[str, float]
    provenance: Mapping[str, Any]
    findings: tuple[Finding, ...] = ()

    @property
    def made(self) -> tuple[FrameSummary, ...]:
        """The frames with an anatomy."""
        return tuple(frame for frame in self.frames if frame.outcome == MADE)

    @property
    def certified(self) -> int:
        """Frames whose map is proved one-to-one; undecided proofs are told, and do not fail a sequence."""
        return sum(frame.claim == Claim.CERTIFIED.value for frame in self.made)

    @property
    def checks(self) -> tuple[Check, ...]:
        """The worst of each check over all frames, and those of the sequence itself."""
        refused = [f for f in self.frames if f.outcome == REFUSED]
        failed = [f for f in self.frames if f.outcome == FAILED]
        checks = [
            _frames_check("refused frames", refused, next_step=next_steps.POSE_REFUSED),
            _frames_check("failed frames", failed, next_step=next_steps.FRAME_FAILED),
            *_worst_checks(self.made),
        ]
        off = [(f.off_rest_mm, _place(f)) for f in self.made if f.off_rest_mm is not None]
        if off:
            value, place = max(off)
            checks.append(Check("rest pose off rest", value, REST_MM, "mm", place, next_step=next_steps.OFF_REST))
        if self.between:
            checks += _between_checks(self.between, self.limits)
        return tuple(checks)

    @property
    def verdict(self) -> Verdict:
        """Passed when every check passed."""
        return verdict_of(self.checks)

    @property
    def looked_closer(self) -> int:
        """Meetings of given triangles that were looked at with finer ones."""
        return sum(passage.triangles > 0 for b in self.between for passage in b.passages)

    @property
    def proved_free(self) -> int:
        """Pairs of consecutive frames between which it is proved that no given triangles of two tissues meet."""
        return sum(b.proved_free for b in self.between)


def summary_of(record: Mapping[str, Any]) -> FrameSummary:
    """A frame of its JSON record."""
    result = record["result"]
    pairs = [] if result is None else result["overlaps"]
    introduced = [(p["a"], p["b"], _number(p["introduced_mm3"])) for p in pairs if _number(p["introduced_mm3"]) != 0.0]
    tissues = [] if result is None else result["tissues"]
    return FrameSummary(
        number=record["number"],
        time_s=record["time_s"],
        pose_deg=record["pose_deg"],
        outcome=record["outcome"],
        problem=record["problem"],
        checks=() if result is None else tuple(_check(check) for check in result["checks"]),
        claim="" if result is None else result["map"]["claim"],
        steps=0 if result is None else result["steps"],
        method="" if result is None else result["method"],
        off_rest_mm=record["off_rest_mm"],
        overlap_mm3=math.fsum(volume for _, _, volume in introduced),
        overlaps=tuple(sorted(introduced, key=lambda pair: -pair[2])),
        muscles=tuple(MuscleMeasures(**muscle) for muscle in record["muscles"]),
        volume_changes={t["name"]: _number(t["volume_change_percent"]) for t in tissues if t["kind"] == "muscle"},
        cpu_s=record["cpu_s"],
    )


def sequence_to_json(report: SequenceReport) -> dict[str, Any]:
    """The report as JSON values; numbers that are not finite become null."""
    return {
        "schema_version": SEQUENCE_SCHEMA_VERSION,
        "title": report.title,
        "verdict": report.verdict,
        "resampling": report.resampling,
        "findings": [asdict(finding) for finding in report.findings],
        "certified_frames": report.certified,
        "limits": dict(report.limits),
        "checks": [_plain_check(check) for check in report.checks],
        "frames": [_frame(frame) for frame in report.frames],
        "proved_free_between": report.proved_free,
        "looked_closer_between": report.looked_closer,
        "between": [_between(between) for between in report.between],
        "cpu_s": dict(report.cpu_s),
        "provenance": dict(report.provenance),
    }


MEASURES = tuple(field.name for field in fields(MuscleMeasures) if field.name != "name")
"""What is measured of each muscle, as columns of a table."""


def measures_table(frames: Sequence[FrameSummary]) -> list[list[str]]:
    """Muscle measures over time as rows of text, headings first; one row per muscle and frame."""
    rows = [["frame", "time_s", "muscle", *MEASURES, "volume_change_percent"]]
    for frame in frames:
        for muscle in frame.muscles:
            values = asdict(muscle)
            cells = ["" if values[k] is None else str(values[k]) for k in MEASURES]
            change = repr(frame.volume_changes[muscle.name])
            rows.append([str(frame.number), repr(frame.time_s), muscle.name, *cells, change])
    return rows


def _worst_checks(frames: Sequence[FrameSummary]) -> list[Check]:
    """Of each check the frame that does worst."""
    worst: dict[str, Check] = {}
    for frame in frames:
        for check in frame.checks:
            known = worst.get(check.name)
            if known is None or _badness(check) > _badness(known):
                place = _place(frame) + (f": {check.place}" if check.place else "")
                worst[check.name] = replace(check, place=place if check.value else "")
    return list(worst.values())


def _badness(check: Check) -> float:
    return math.inf if math.isnan(check.value) else check.value


def _between_checks(between: Sequence[BetweenSummary], limits: Mapping[str, float | None]) -> list[Check]:
    left = [b for b in between if b.problem]
    checks = [
        _meeting_check(
            "passed through between frames", between, MeetingKind.THROUGH, next_step=next_steps.PASSED_THROUGH
        ),
        _meeting_check("not settled between frames", between, MeetingKind.UNSETTLED, next_step=next_steps.NOT_SETTLED),
        Check(
            "not examined between frames",
            float(len(left)),
            0.0,
            "pairs of frames",
            f"frames {left[0].first} and {left[0].second}: {left[0].problem}" if left else "",
            next_step=next_steps.NOT_EXAMINED,
        ),
    ]
    overlaps = [
        (p.most_overlap_mm3, _meeting_place(b, p))
        for b in between
        for p in b.passages
        if not MeetingKind(p.kind).fails and not math.isnan(p.most_overlap_mm3)
    ]
    if overlaps:
        worst, place = max(overlaps)
        known = limits["introduced_overlap_mm3"]
        limit = math.inf if known is None else known
        checks.append(
            Check(
                "introduced overlap between frames",
                worst,
                limit,
                "mm³",
                place if worst else "",
                next_step=next_steps.NEW_OVERLAP,
            )
        )
    return checks


def _meeting_check(name: str, between: Sequence[BetweenSummary], kind: MeetingKind, *, next_step: str) -> Check:
    """None of the meetings may be of this kind."""
    found = [(b, passage) for b in between for passage in b.of_kind(kind)]
    place = ""
    if found:
        b, p = found[0]
        place = _meeting_place(b, p)
        place += f": {p.note}" if p.note else ""
    return Check(name, float(len(found)), 0.0, "pairs", place, next_step=next_step)


def _frames_check(name: str, frames: Sequence[FrameSummary], *, next_step: str) -> Check:
    """No frame may have ended so."""
    problem = frames[0].problem if frames else ""
    return Check(name, float(len(frames)), 0.0, "frames", problem, next_step=next_step)


def _meeting_place(between: BetweenSummary, passage: PassageSummary) -> str:
    where = f"between frames {between.first} and {between.second}"
    return f"{passage.a} / {passage.b} at {passage.time_s:.4g} s, {where}"


def _place(frame: FrameSummary) -> str:
    return f"frame {frame.number} at {frame.time_s:.4g} s"


def _check(said: Mapping[str, Any]) -> Check:
    limit = math.inf if said["limit"] is None else float(said["limit"])
    return Check(said["name"], _number(said["value"]), limit, said["unit"], said["place"], next_step=said["next_step"])


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _plain_check(check: Check) -> dict[str, Any]:
    return {
        "name": check.name,
        "value": _finite(check.value),
        "limit": _finite(check.limit),
        "unit": check.unit,
        "place": check.place,
        "passed": check.passed,
        "next_step": check.next_step,
    }


def _frame(frame: FrameSummary) -> dict[str, Any]:
    return {
        "number": frame.number,
        "time_s": frame.time_s,
        "pose_deg": dict(frame.pose_deg),
        "outcome": frame.outcome,
        "verdict": frame.verdict,
        "problem": frame.problem,
        "claim": frame.claim,
        "steps": frame.steps,
        "off_rest_mm": frame.off_rest_mm,
        "introduced_overlap_mm3": _finite(frame.overlap_mm3),
        "overlaps": [{"a": a, "b": b, "introduced_mm3": _finite(v)} for a, b, v in frame.overlaps],
        "checks": [_plain_check(check) for check in frame.checks],
        "muscles": [asdict(muscle) for muscle in frame.muscles],
        "cpu_s": dict(frame.cpu_s),
    }


def _between(between: BetweenSummary) -> dict[str, Any]:
    passages = [
        {key: _finite(value) if isinstance(value, float) else value for key, value in asdict(passage).items()}
        for passage in between.passages
    ]
    return {**asdict(between), "passages": passages, "proved_free": between.proved_free}
