"""Finished runs side by side: what was set otherwise, what came out otherwise, and which is better; knows no file.

A value is better where it is smaller, since every check and every measure judged here tells how far something is off.
Values that differ by less than a thousandth, or both lie below a thousandth of their limit, count as the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import PurePath
from typing import Any

from musclefit.vocabulary import Claim

SAME = 1e-3
"""Relative difference, and share of a limit, below which two values count as the same."""

_STRENGTH = (Claim.CERTIFIED.value, Claim.SAMPLED.value, Claim.UNDECIDED.value, Claim.REFUTED.value, "none")
"""Claims, the strongest first."""

Values = tuple[float | None, ...]


@dataclass(frozen=True, slots=True)
class MeasureRow:
    """One quantity of every run.

    Parameters
    ----------
    name, unit : str
    values : tuple of float or None
        One for each run; None where it was not measured.
    passed : tuple of bool or None
        Against the run's own limit; None where there is no such check, or it has no limit.
    best : tuple of int
        The runs whose value is best; none where all are the same, or none is better by being smaller.
    """

    name: str
    unit: str
    values: Values
    passed: tuple[bool | None, ...]
    best: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class TissueRow:
    """One tissue of every run; None where a run does not have it, or did not measure.

    ``apart_mm`` is the farthest that a vertex given to both lies from where the first run takes it. ``best`` are the
    runs whose bone is nearest to rigid, or whose muscle keeps its volume best, where these have limits.
    """

    name: str
    kind: str
    volume_change_percent: Values
    rigidity_mm: Values
    outside_skin_introduced_mm3: Values
    apart_mm: Values
    best: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class PairRow:
    """The overlap of two tissues in every run; None where a run lacks one of them, or could not check them."""

    a: str
    b: str
    deformed_mm3: Values
    introduced_mm3: Values
    best: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SettingRow:
    """Something that was not the same in all runs: a setting, a version, an input file; "" where a run has none."""

    name: str
    values: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One time of sequences; values are None where a sequence has no frame then, or has not made it.

    Parameters
    ----------
    time_s : float
    outcomes : tuple of str
        What came of the frame of each sequence; "" where it has none at this time.
    muscle_change_percent, introduced_mm3, apart_mm : tuple of float or None
        The largest change of a muscle's volume, all overlap that is introduced, and the farthest that a given vertex
        lies from where the first sequence takes it.
    """

    time_s: float
    outcomes: tuple[str, ...]
    muscle_change_percent: Values
    introduced_mm3: Values
    apart_mm: Values


@dataclass(frozen=True, slots=True)
class Differences:
    """Runs, or sequences, side by side.

    Parameters
    ----------
    runs : tuple of str
        What the runs are called here; the first is what the others are held against.
    titles, verdicts, claims, mesh_claims : tuple of str
    best : int or None
        The better run, where there is one.
    because : str
        Why that one is better, or why none is.
    settings : tuple of SettingRow
    measures : tuple of MeasureRow
    tissues : tuple of TissueRow
        Those that differ most first.
    pairs : tuple of PairRow
        Those that overlap in any run; those that differ most first.
    notes : tuple of str
        What stands in the way of a fair comparison.
    frames : tuple of FrameRow
        Of sequences, in order of time.
    """

    runs: tuple[str, ...]
    titles: tuple[str, ...]
    verdicts: tuple[str, ...]
    claims: tuple[str, ...]
    mesh_claims: tuple[str, ...]
    best: int | None
    because: str
    settings: tuple[SettingRow, ...]
    measures: tuple[MeasureRow, ...]
    tissues: tuple[TissueRow, ...]
    pairs: tuple[PairRow, ...]
    notes: tuple[str, ...]
    frames: tuple[FrameRow, ...] = ()

    @property
    def letters(self) -> tuple[str, ...]:
        """A letter for each run, for the heads of narrow columns; numbers where letters run out."""
        return tuple(chr(65 + k) if len(self.runs) <= 26 else str(k + 1) for k in range(len(self.runs)))

    def to_json(self) -> dict[str, Any]:
        """All of it, for programs."""
        return asdict(self)


def differences(
    reports: Mapping[str, Mapping[str, Any]], *, apart_mm: Mapping[str, Values], notes: Sequence[str] = ()
) -> Differences:
    """Put runs side by side.

    Parameters
    ----------
    reports : mapping of name to report.json
        At least two.
    apart_mm : mapping of tissue to values
        How far each run's tissue lies from the first run's; may lack tissues.
    notes : sequence of str
        Put behind those that the reports give rise to.
    """
    told = tuple(reports.values())
    claims = tuple(str(one["map"]["claim"]) for one in told)
    mesh_claims = tuple("none" if one["mesh"] is None else str(one["mesh"]["claim"]) for one in told)
    measures = measure_rows(told)
    best, because = better_of(
        tuple(reports),
        told,
        (
            ("its map has the stronger claim", [_weakness(claim) for claim in claims]),
            ("its tetrahedra have the stronger claim", [_weakness(claim) for claim in mesh_claims]),
        ),
    )
    return Differences(
        runs=tuple(reports),
        titles=tuple(str(one["title"]) for one in told),
        verdicts=tuple(str(one["verdict"]) for one in told),
        claims=claims,
        mesh_claims=mesh_claims,
        best=best,
        because=because,
        settings=setting_rows(told),
        measures=(*measures, *_unjudged(told)),
        tissues=tissue_rows(told, apart_mm),
        pairs=pair_rows(told),
        notes=(*notes_on(tuple(reports), told), *notes),
    )


def best_of(values: Sequence[float | None], limits: Sequence[float | None]) -> tuple[int, ...]:
    """The places of the smallest sizes, all that count as the same among them; none where all do, or fewer than two.

    What was not measured is worse than any value.
    """
    sizes = [math.inf if value is None else abs(value) for value in values]
    least = min(range(len(sizes)), key=sizes.__getitem__, default=0)
    best = tuple(k for k in range(len(sizes)) if _same(sizes[k], sizes[least], limits[k], limits[least]))
    return best if len(sizes) > 1 and len(best) < len(sizes) else ()


def _same(a: float, b: float, limit_a: float | None, limit_b: float | None) -> bool:
    floor = SAME * min(limit_a or 0.0, limit_b or 0.0)
    return a == b or abs(a - b) <= SAME * max(a, b) < math.inf or max(a, b) <= floor


def measure_rows(told: Sequence[Mapping[str, Any]]) -> tuple[MeasureRow, ...]:
    """Every check of any run."""
    by_name = [{check["name"]: check for check in one["checks"]} for one in told]
    rows = []
    for name in _all(check["name"] for one in told for check in one["checks"]):
        own = [checks.get(name) for checks in by_name]
        values = tuple(None if check is None else check["value"] for check in own)
        limits = [None if check is None else check["limit"] for check in own]
        unit = next(str(check["unit"]) for check in own if check is not None)
        passed = tuple(None if check is None or check["limit"] is None else bool(check["passed"]) for check in own)
        known = None not in own
        rows.append(MeasureRow(name, unit, values, passed, best_of(values, limits) if known else ()))
    return tuple(rows)


def _unjudged(told: Sequence[Mapping[str, Any]]) -> tuple[MeasureRow, ...]:
    """What no limit is set to, and what is not better by being smaller."""
    rows: dict[tuple[str, str], Values] = {
        ("smallest det J at a point", ""): tuple(one["map"]["min_jacobian_determinant"] for one in told),
        ("steps", ""): tuple(float(one["steps"]) for one in told),
        ("sum of stages", "s"): tuple(math.fsum(one["timings_s"].values()) for one in told),
        ("peak memory", "MB"): tuple(one["peak_memory_mb"] for one in told),
    }
    return tuple(MeasureRow(name, unit, values, (None,) * len(told), ()) for (name, unit), values in rows.items())


def better_of(
    names: tuple[str, ...],
    told: Sequence[Mapping[str, Any]],
    by_claims: Sequence[tuple[str, Sequence[float]]],
) -> tuple[int | None, str]:
    """The better one and why: by failed checks, then by claims, then where no measure is worse and one is better.

    Parameters
    ----------
    names : tuple of str
    told : sequence of mapping
        Reports, with their checks.
    by_claims : sequence of (why, ranks)
        How weak the claims of each are, the weightiest first.
    """
    failed = [sum(not check["passed"] for check in one["checks"]) for one in told]
    left = list(range(len(names)))
    for why, ranks in (("it fails fewer checks", failed), *by_claims):
        least = min(ranks[k] for k in left)
        fewer = [k for k in left if ranks[k] == least]
        if len(fewer) == 1:
            return fewer[0], why
        left = fewer
    among = tuple(told[k] for k in left)
    judged = [row for row in measure_rows(among) if row.best]
    if not judged:
        return None, f"{_listed(names, left)} are the same in all that is judged"
    never_worse = [k for place, k in enumerate(left) if all(place in row.best for row in judged)]
    if len(never_worse) == 1:
        return never_worse[0], "as many checks fail and the claims are the same, and no check of it is worse"
    return None, f"as many checks fail and the claims are the same; {_listed(names, left)} are each better in something"


def _weakness(claim: str) -> int:
    return _STRENGTH.index(claim) if claim in _STRENGTH else len(_STRENGTH)


def _listed(names: tuple[str, ...], some: Sequence[int]) -> str:
    return " and ".join(names[k] for k in some)


def tissue_rows(told: Sequence[Mapping[str, Any]], apart_mm: Mapping[str, Values]) -> tuple[TissueRow, ...]:
    """Every tissue of any run, those that differ most first; ``apart_mm`` by tissue."""
    by_name = [{tissue["name"]: tissue for tissue in one["tissues"]} for one in told]
    rows = []
    for name in _all(tissue["name"] for one in told for tissue in one["tissues"]):
        own = [tissues.get(name) for tissues in by_name]
        kind = next(str(tissue["kind"]) for tissue in own if tissue is not None)

        def values(key: str, own: Sequence[Mapping[str, Any] | None] = own) -> Values:
            return tuple(None if tissue is None else tissue[key] for tissue in own)

        judged, limit = {
            "bone": ("rigidity_mm", "bone_rigidity_mm"),
            "muscle": ("volume_change_percent", "muscle_volume_percent"),
        }.get(kind, ("", ""))
        limits = [one["limits"].get(limit) for one in told]
        best = best_of(values(judged), limits) if judged and None not in own and None not in limits else ()
        rows.append(
            TissueRow(
                name,
                kind,
                values("volume_change_percent"),
                values("rigidity_mm"),
                values("outside_skin_introduced_mm3"),
                apart_mm.get(name, (None,) * len(told)),
                best,
            )
        )
    return tuple(sorted(rows, key=lambda row: (-_spread(row.apart_mm), -_spread(row.volume_change_percent), row.name)))


def pair_rows(told: Sequence[Mapping[str, Any]]) -> tuple[PairRow, ...]:
    """Every pair that overlaps in any run, those that differ most first."""
    found = [{tuple(sorted((pair["a"], pair["b"]))): pair for pair in one["overlaps"]} for one in told]
    there = [{tissue["name"] for tissue in one["tissues"]} for one in told]
    unchecked = [{name for left in one["not_checked"] for name in str(left["what"]).split(" / ")} for one in told]
    rows = []
    for a, b in sorted({pair for pairs in found for pair in pairs}):

        def values(key: str, a: str = a, b: str = b) -> Values:
            """Zero for a pair that a run tested and does not list."""
            return tuple(
                pairs[a, b][key] if (a, b) in pairs else 0.0 if {a, b} <= names - left else None
                for pairs, names, left in zip(found, there, unchecked, strict=True)
            )

        introduced = values("introduced_mm3")
        best = best_of(introduced, [None] * len(told)) if None not in introduced else ()
        rows.append(PairRow(a, b, values("deformed_mm3"), introduced, best))
    return tuple(sorted(rows, key=lambda row: (-_spread(row.introduced_mm3), -_spread(row.deformed_mm3), row.a, row.b)))


def setting_rows(told: Sequence[Mapping[str, Any]]) -> tuple[SettingRow, ...]:
    """Settings, versions and input files that are not the same in all runs; title and overrides are told elsewhere."""
    flat = [_flat(one["provenance"]) for one in told]
    left_out = ("settings.title", "settings.overrides", "settings.purpose_because", "platform", "workers")
    rows = []
    for key in _all(key for one in flat for key in one):
        values = tuple(one.get(key, "") for one in flat)
        if len(set(values)) > 1 and not key.startswith(left_out) and not _same_file(values, told):
            rows.append(SettingRow(key.removeprefix("settings."), values))
    return tuple(rows)


def _same_file(values: Sequence[str], told: Sequence[Mapping[str, Any]]) -> bool:
    """Whether values are paths of files of one name and the same bytes."""
    names = {PurePath(value).name for value in values}
    digests = {one["provenance"].get("input_sha256", {}).get(name) for one in told for name in names}
    return len(names) == 1 and len(digests) == 1 and None not in digests


def _flat(value: Any, above: str = "") -> dict[str, str]:
    if isinstance(value, Mapping):
        return {
            key: text
            for name, item in value.items()
            for key, text in _flat(item, f"{above}.{name}" if above else str(name)).items()
        }
    if isinstance(value, list):
        return {above: ", ".join(_said(item) for item in value)}
    return {above: _said(value)}


def _said(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return " ".join(_said(item) for item in value)
    return "none" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


def notes_on(names: tuple[str, ...], told: Sequence[Mapping[str, Any]]) -> list[str]:
    """Where the runs are not of the same tissues, or were held to other limits."""
    notes = []
    first = {tissue["name"]: tissue["rest_volume_mm3"] for tissue in told[0]["tissues"]}
    for name, one in zip(names[1:], told[1:], strict=True):
        own = {tissue["name"]: tissue["rest_volume_mm3"] for tissue in one["tissues"]}
        missing = sorted(first.keys() ^ own.keys())
        if missing:
            notes.append(f"{names[0]} and {name} do not have the same tissues: {_few(missing)} in one alone")
        other = sorted(
            key for key in first.keys() & own.keys() if not math.isclose(first[key], own[key], rel_tol=1e-4, abs_tol=0)
        )
        if other:
            notes.append(
                f"{names[0]} and {name} have other volumes at rest, so that they are of other bodies: {_few(other)}"
            )
        if any(row.name.startswith("drive.") for row in setting_rows((told[0], one))):
            notes.append(f"{names[0]} and {name} were driven to other places, which shows in all that follows")
        if one["limits"] != told[0]["limits"]:
            notes.append(f"{names[0]} and {name} were held to other limits; each is judged by its own")
    return notes


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def _spread(values: Values) -> float:
    known = [value for value in values if value is not None]
    return max(known) - min(known) if len(known) > 1 else max(map(abs, known), default=0.0)


def _all(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))
