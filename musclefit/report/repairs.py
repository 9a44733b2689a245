"""What was repaired, held against its limits, and the same as JSON values; computes no geometry."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.repair.records import Change, Deviation, Repaired, RepairSettings
from musclefit.anatomy.repair.resolutions import Choice, PairResolution, Resolved, Rule, TissueCut
from musclefit.geometry.surfaces.faults import Faults
from musclefit.report import next_steps
from musclefit.report.model import SCHEMA_VERSION, Verdict, verdict_of
from musclefit.report.schema import Json
from musclefit.validate.model import Check, OverlapCheck


@dataclass(frozen=True, slots=True)
class Outcome:
    """One tissue from its file to the end: volumes, mm³, what its pieces share counted once, and pieces."""

    name: str
    volume_before_mm3: float
    volume_after_mm3: float
    pieces_before: int
    pieces_after: int

    @property
    def change_percent(self) -> float:
        """Of the volume as given, whichever way its faces turned; infinite where that was none."""
        given, now = abs(self.volume_before_mm3), abs(self.volume_after_mm3)
        return 100.0 * (now - given) / given if given else math.inf

    def said(self) -> str:
        """The tissue with what it lost or gained, and its pieces."""
        volumes = f"{self.volume_before_mm3:.5g} to {self.volume_after_mm3:.5g} mm³, {self.change_percent:+.1f} %"
        return f"{self.name}: {volumes}; {self.pieces_before} to {self.pieces_after} pieces"


@dataclass(frozen=True, eq=False, slots=True)
class RepairReport:
    """One repair of a surface or a folder of them.

    Parameters
    ----------
    title : str
    settings : RepairSettings
    rule : Rule
    choice : Choice
    surfaces : tuple of Repaired
    findings : tuple of Finding
        From reading the files.
    resolved : Resolved or None
        None where overlaps were left as they are.
    overlaps : OverlapCheck or None
        Of the result; None where overlaps were left as they are.
    """

    title: str
    settings: RepairSettings
    rule: Rule
    choice: Choice
    surfaces: tuple[Repaired, ...]
    findings: tuple[Finding, ...]
    resolved: Resolved | None
    overlaps: OverlapCheck | None
    timings_s: Mapping[str, float] = field(default_factory=dict)
    peak_memory_mb: float = math.nan
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """What became of each surface, from its file to the end."""
        cuts = {cut.name: cut for cut in self.resolved.cuts} if self.resolved else {}
        ends = [(one, cuts.get(one.name, one)) for one in self.surfaces]
        return tuple(
            Outcome(
                one.name,
                one.volume_before_mm3 - _counted_twice(one),
                end.volume_after_mm3,
                one.pieces_before,
                end.pieces_after,
            )
            for one, end in ends
        )

    @property
    def checks(self) -> tuple[Check, ...]:
        """Surfaces that are not valid, the largest distance from an original, losses, and pairs that still overlap."""
        invalid = {s.name: s.after for s in self.surfaces if not s.after.none}
        invalid |= {cut.name: cut.after for cut in self.resolved.cuts if not cut.after.none} if self.resolved else {}
        far = max(self.surfaces, key=lambda s: s.deviation.largest_mm)
        checks = [
            _none_of("surfaces that are not valid", len(invalid), ", ".join(list(invalid)[:4]), next_steps.NOT_VALID),
            Check(
                "distance from the original",
                far.deviation.largest_mm,
                self.settings.limit_mm,
                "mm",
                far.name,
                next_step=next_steps.TOO_FAR,
            ),
            *self._losses(),
        ]
        if self.resolved is not None:
            left = self.resolved.left
            first = " / ".join(left[0]) if left else ""
            checks.append(_none_of("pairs that still meet", len(left), first, next_steps.STILL_MEET))
        if self.overlaps is not None:
            pairs, doubtful = self.overlaps.pairs, self.overlaps.not_checked
            volume = math.fsum(pair.rest_mm3 for pair in pairs)
            most = f"{pairs[0].a} / {pairs[0].b}" if pairs else ""
            checks.append(Check("overlap left", volume, 0.0, "mm³", most, next_step=next_steps.STILL_MEET))
            unchecked = doubtful[0].what if doubtful else ""
            checks.append(_none_of("not checked", len(doubtful), unchecked, next_steps.NOT_VALID))
        return tuple(checks)

    def _losses(self) -> list[Check]:
        """A check for each tissue whose volume changed too much or that fell apart, or one for the largest change."""
        limit, checks = self.settings.max_change_percent, []
        largest = max(self.outcomes, key=lambda one: abs(one.change_percent))
        for one in self.outcomes:
            if abs(one.change_percent) > limit or one is largest:
                size = abs(one.change_percent)
                checks.append(
                    Check("change of volume", size, limit, "%", one.said(), next_step=next_steps.CHANGED_MUCH)
                )
            if one.pieces_after > one.pieces_before:
                count, most = float(one.pieces_after), float(one.pieces_before)
                checks.append(Check("pieces", count, most, "", one.said(), next_step=next_steps.FELL_APART))
        return checks

    @property
    def verdict(self) -> Verdict:
        """Passed when every check passed."""
        return verdict_of(self.checks)


def _counted_twice(one: Repaired) -> float:
    return math.fsum(change.volume_mm3 for change in one.changes if change.code == "united-pieces")


def _none_of(name: str, count: int, place: str, next_step: str) -> Check:
    """None of these may be left."""
    return Check(name, float(count), 0.0, "", place, next_step=next_step)


def repair_json(report: RepairReport) -> Json:
    """The report as JSON values; numbers that are not finite become null."""
    resolved = report.resolved
    return {
        "schema_version": SCHEMA_VERSION,
        "title": report.title,
        "verdict": report.verdict,
        "rule": report.rule.value,
        "choice": report.choice.value,
        "settings": _plain(asdict(report.settings)),
        "surfaces": [_surface(surface) for surface in report.surfaces],
        "tissues": [_tissue(one) for one in report.outcomes],
        "findings": [{"subject": f.subject, "code": f.code, "message": f.message} for f in report.findings],
        "overlaps_resolved": [] if resolved is None else [_pair(pair) for pair in resolved.pairs],
        "cuts": [] if resolved is None else [_cut(cut) for cut in resolved.cuts],
        "pairs_that_still_meet": [] if resolved is None else [list(pair) for pair in resolved.left],
        "clearance_mm": None if resolved is None else resolved.clearance_mm,
        "pairs_below_clearance": [] if resolved is None else [_plain(asdict(gap)) for gap in resolved.gaps],
        "tissues_with_thin_places": [] if resolved is None else [_plain(asdict(thin)) for thin in resolved.thin],
        "checks": [_plain({**asdict(check), "passed": check.passed}) for check in report.checks],
        "timings_s": _plain(dict(report.timings_s)),
        "peak_memory_mb": _plain(report.peak_memory_mb),
        "provenance": _plain(dict(report.provenance)),
    }


def _surface(found: Repaired) -> Json:
    return {
        "name": found.name,
        "way": found.way.value,
        "passed": found.passed,
        "faults_before": _faults(found.before),
        "faults_after": _faults(found.after),
        "changes": [_change(change) for change in found.changes],
        "distance": _distance(found.deviation),
        "volume_before_mm3": _plain(found.volume_before_mm3),
        "volume_after_mm3": _plain(found.volume_after_mm3),
        "triangles": len(found.mesh.faces),
    }


def _tissue(one: Outcome) -> Json:
    plain: Json = _plain({**asdict(one), "change_percent": one.change_percent})
    return plain


def _faults(found: Faults) -> Json:
    return {name: count for name, count in asdict(found).items() if count}


def _change(found: Change) -> Json:
    kept: Json = _plain(asdict(found))
    return kept


def _distance(found: Deviation) -> Json:
    plain: Json = _plain(asdict(found))
    return plain


def _pair(found: PairResolution) -> Json:
    plain: Json = _plain(asdict(found))
    return plain


def _cut(found: TissueCut) -> Json:
    return {
        "name": found.name,
        "volume_before_mm3": _plain(found.volume_before_mm3),
        "volume_after_mm3": _plain(found.volume_after_mm3),
        "pieces_before": found.pieces_before,
        "pieces_after": found.pieces_after,
        "cut_around_others_mm": found.clearance_mm,
        "changes": [_change(change) for change in found.changes],
        "faults_after": _faults(found.after),
    }


def _plain(value: Any) -> Any:
    """The value with tuples as lists and numbers that are not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
