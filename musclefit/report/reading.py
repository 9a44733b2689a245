"""Reports that come back from files: whether they are as they were written, or what is wrong, in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, TypeAdapter, ValidationError

from musclefit.report.document import Check, Count, Finding, Number, Outcome, Part, RunDocument, Verdict, plain
from musclefit.report.sequence import FrameSummary


class _Frame(Part):
    number: Count
    time_s: float
    pose_deg: dict[str, Number]
    outcome: str
    verdict: Verdict
    problem: str
    claim: str
    steps: Count
    off_rest_mm: Number
    introduced_overlap_mm3: Number
    overlaps: list[dict[str, Any]]
    checks: list[Check]
    muscles: list[dict[str, Any]]
    cpu_s: dict[str, float]


class _Sequence(Part):
    schema_version: int
    title: str
    verdict: Verdict
    resampling: str
    findings: list[Finding]
    certified_frames: Count
    limits: dict[str, Number]
    checks: list[Check]
    frames: list[_Frame]
    proved_free_between: Count
    looked_closer_between: Count
    between: list[dict[str, Any]]
    cpu_s: dict[str, Number]
    provenance: Annotated[dict[str, Any], BeforeValidator(plain)]


_FRAME: TypeAdapter[FrameSummary] = TypeAdapter(FrameSummary)


def wrong_in_run_report(told: Mapping[str, Any]) -> str:
    """What is not as ``report_schema`` says in the report of a run; "" where all is."""
    return _wrong(RunDocument.model_validate, told) or _wrong_settings(told)


def wrong_in_sequence_report(told: Mapping[str, Any]) -> str:
    """What is not as `musclefit sequence` writes it in the report of one; "" where all is."""
    return _wrong(_Sequence.model_validate, told) or _wrong_settings(told)


def wrong_in_frame(result: object, summary: FrameSummary) -> str:
    """What is not as written in a frame's measures and their summary; "" where all is."""
    return _wrong(_FRAME.validate_python, summary) or ("" if result is None else _wrong(Outcome.model_validate, result))


def _wrong(check: Callable[[Any], object], told: object) -> str:
    try:
        check(told)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        return f"{'.'.join(map(str, first['loc']))[:80] or 'its top'}: {first['msg']}"
    except (TypeError, OverflowError, RecursionError) as error:  # a value of another type where a number is read
        return str(error)
    return ""


def _wrong_settings(told: Mapping[str, Any]) -> str:
    """What else is read from the settings that a report repeats."""
    settings = told["provenance"].get("settings")
    if not isinstance(settings, Mapping):
        return "provenance.settings: missing"
    for section in ("anatomy", "drive"):
        if not isinstance(settings.get(section), Mapping):
            return f"provenance.settings.{section}: missing"
    return "" if isinstance(settings["anatomy"].get("frame"), str) else "provenance.settings.anatomy.frame: missing"
