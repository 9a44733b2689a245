"""The folder of a case of a study: what came of it, of which input, and what it cost; read back or found missing."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter

from musclefit._version import __version__
from musclefit.io.atomic import write_atomically
from musclefit.io.studies import Case, Study

SUBJECTS, CASE, COST, BEGUN, RESULT = "subjects", "case.json", "cost.json", "begun.json", "result"

PASSED, OFF_LIMITS, REFUSED, BROKE_OFF = "passed", "limits broken", "input refused", "broke off"
MISSING = "not run"


@dataclass(frozen=True, slots=True)
class CaseOutcome:
    """What came of a case.

    Parameters
    ----------
    name, subject, rig, motion, facts
        As in `Case`.
    status : str
        "passed", "limits broken", "input refused", "broke off" or "not run".
    reason : str
        Why it did not pass, in words; "" where it did.
    values : mapping of str to number, text or None
        Measures, by name with unit; None where not measured.
    checks : tuple of mapping
        Every check with value, limit, unit and place.
    key : str
        The hash of all it depends on; "" where that is not known, so that it is made again.
    inputs : mapping of path to SHA-256
    """

    name: str
    subject: str
    rig: str
    motion: str
    facts: Mapping[str, str]
    status: str
    reason: str = ""
    values: Mapping[str, float | str | None] = field(default_factory=dict)
    checks: tuple[Mapping[str, Any], ...] = ()
    key: str = ""
    inputs: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, case: Case, status: str, **known: Any) -> CaseOutcome:
        """The outcome of a case."""
        return cls(case.name, case.subject, case.rig, case.motion, dict(case.facts), status, **known)


@dataclass(frozen=True, slots=True)
class CaseCost:
    """What a case took: CPU and wall seconds, and the peak memory of its process so far, MB; and its sizes.

    None where the process ended without a word. ``cases_before`` were made by its process before: the first takes what
    it takes to start, too.
    """

    cpu_s: float | None
    wall_s: float | None
    process_peak_mb: float | None
    sizes: Mapping[str, Any] = field(default_factory=dict)
    cases_before: int = 0


def case_folder(out: Path, name: str) -> Path:
    """Where a case lies."""
    return out / SUBJECTS / name


def case_key(case: Case, study: Study, inputs: Mapping[str, str]) -> str:
    """What a case depends on, as a hash: version, files by content, overrides, how it is run; not what is but told."""
    told = {
        "version": __version__,
        "inputs": dict(inputs),
        "overrides": case.overrides,
        "run": [study.pictures, study.tets, study.frames],
    }
    return sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def write_case(out: Path, outcome: CaseOutcome, cost: CaseCost) -> None:
    """Write what came of a case, last of all that is in its folder: what has it is whole."""
    folder = case_folder(out, outcome.name)
    write_atomically(folder / COST, json.dumps(asdict(cost), indent=1) + "\n")
    write_atomically(folder / CASE, json.dumps(asdict(outcome), indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def read_case(out: Path, name: str) -> CaseOutcome | None:
    """What came of a case; None where it is not there whole, or is of another case."""
    found = _read(_OUTCOME, case_folder(out, name) / CASE)
    return found if found is not None and found.name == name else None


def read_cost(out: Path, name: str) -> CaseCost | None:
    """What a case took; None where that is not there."""
    return _read(_COST, case_folder(out, name) / COST)


def is_done(outcome: CaseOutcome | None, key: str) -> bool:
    """Whether a case need not be made again: made of the same input, and not broken off."""
    return outcome is not None and bool(key) and outcome.key == key and outcome.status != BROKE_OFF


_OUTCOME: TypeAdapter[CaseOutcome] = TypeAdapter(CaseOutcome)
_COST: TypeAdapter[CaseCost] = TypeAdapter(CaseCost)


_T = TypeVar("_T")


def _read(kind: TypeAdapter[_T], path: Path) -> _T | None:
    """What a file holds; None where it is not there, or not of this kind."""
    try:
        return kind.validate_python(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError):
        return None
