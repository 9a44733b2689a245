"""What processes of a study do: one case from its files to its folder; whatever happens, its outcome is written."""

from __future__ import annotations

import itertools
import json
import math
import shutil
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from musclefit.errors import InputError, MusclefitError
from musclefit.io.atomic import write_atomically
from musclefit.io.case_folders import (
    BEGUN,
    BROKE_OFF,
    OFF_LIMITS,
    PASSED,
    REFUSED,
    RESULT,
    CaseCost,
    CaseOutcome,
    case_folder,
    case_key,
    is_done,
    read_case,
    write_case,
)
from musclefit.io.folder_locks import held
from musclefit.io.provenance import cpu_seconds, peak_memory_mb
from musclefit.io.studies import Case, FileHashes, Study, inputs_of
from musclefit.progress import Silent
from musclefit.report.model import Report, Side
from musclefit.rig.job import Job
from musclefit.validate.model import Check

TRACEBACK = "traceback.txt"

ATTEMPTS = 3
"""How often a case is tried whose process ends without a word."""

WAIT_S = 0.2
"""Between two looks at whether another process is done with a case."""

_here: list[tuple[Study, Path, FileHashes]] = []
"""What this process was prepared for; a worker serves one study."""

_cases_made = itertools.count()
"""Of this process."""


def prepare(study: Study, out: Path) -> None:
    """Prepare this process for a study."""
    _here[:] = [(study, out, FileHashes())]


def make(number: int) -> CaseOutcome:
    """Make the case of a number."""
    study, out, hashes = _here[0]
    return make_case(study, study.cases[number], out, hashes=hashes)


def make_case(study: Study, case: Case, out: Path, *, hashes: FileHashes) -> CaseOutcome:
    """Make one case and write its folder, unless it is there already, made of the same input.

    While another process makes the case, as one whose own study was killed may, this waits and takes what that made.

    Returns
    -------
    CaseOutcome
        Also of a case that failed, whatever made it fail; only what ends a process is not caught.
    """
    with _held_once_free(case_folder(out, case.name)):
        return _made_unless_done(study, case, out, hashes)


@contextmanager
def _held_once_free(folder: Path) -> Iterator[None]:
    """Hold the folder of a case until the block ends, as soon as no other process holds it."""
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(held(folder))
                break
            except InputError:  # that it is being written by another process
                time.sleep(WAIT_S)
        yield


def _made_unless_done(study: Study, case: Case, out: Path, hashes: FileHashes) -> CaseOutcome:
    start, cpu = time.perf_counter(), cpu_seconds()
    folder = case_folder(out, case.name)
    inputs: Mapping[str, str] = {}
    sizes: dict[str, Any] = {}
    key = ""
    try:
        inputs = inputs_of(case, hashes)
        key = case_key(case, study, inputs)
        former = read_case(out, case.name)
        if former is not None and is_done(former, key):
            return former
        _begin(folder, key)
        outcome = _made(study, case, folder / RESULT, sizes)
    except InputError as error:
        outcome = CaseOutcome.of(case, REFUSED, reason=str(error))
    except MusclefitError as error:
        outcome = CaseOutcome.of(case, BROKE_OFF, reason=str(error))
    except Exception as error:
        write_atomically(folder / TRACEBACK, traceback.format_exc())
        said = f"{type(error).__name__}: {error}"
        outcome = CaseOutcome.of(case, BROKE_OFF, reason=f"{said}; see {TRACEBACK} in its folder, and report it")
    seen = set(inputs.values())
    outcome = replace(outcome, key=key if set(outcome.inputs.values()) <= seen else "", inputs=dict(inputs))
    cost = CaseCost(
        cpu_s=round(cpu_seconds() - cpu, 3),
        wall_s=round(time.perf_counter() - start, 3),
        process_peak_mb=round(peak_memory_mb(), 1),
        sizes=sizes,
        cases_before=next(_cases_made),
    )
    write_case(out, outcome, cost)
    return outcome


def died(study: Study, number: int, out: Path, *, times: int) -> CaseOutcome:
    """The outcome of a case whose process ended without a word, written."""
    return broke_off(
        study.cases[number],
        out,
        reason=f"its process ended {times} times without a word, as when memory runs out; run it by itself, or with "
        "fewer workers",
    )


def broke_off(case: Case, out: Path, *, reason: str) -> CaseOutcome:
    """The outcome of a case of which no process could tell, written."""
    outcome = CaseOutcome.of(case, BROKE_OFF, reason=reason)
    write_case(out, outcome, CaseCost(None, None, None))
    return outcome


def _begin(folder: Path, key: str) -> None:
    """Clear what a former case of other input left; what was begun of the same input goes on."""
    try:
        begun = json.loads((folder / BEGUN).read_text(encoding="utf-8"))["key"]
    except (OSError, ValueError, KeyError, TypeError):
        begun = ""
    if begun != key and folder.exists():
        shutil.rmtree(folder)
    (folder / TRACEBACK).unlink(missing_ok=True)
    for left in folder.glob(f".{RESULT}.partial-*"):  # of a process that was killed while it wrote
        shutil.rmtree(left, ignore_errors=True)
    write_atomically(folder / BEGUN, json.dumps({"key": key}) + "\n")


def _made(study: Study, case: Case, result: Path, sizes: dict[str, Any]) -> CaseOutcome:
    tets = () if study.tets is None else (f"tets.enabled={str(study.tets).lower()}",)
    overrides = (*case.overrides, *tets)
    if case.motion_file is not None:
        from musclefit.workflows.sequence import sequence

        followed = sequence(
            case.rig_file,
            case.motion_file,
            out=result,
            frames=study.frames,
            overrides=overrides,
            pictures=study.pictures,
            progress=Silent(),
        )
        sizes |= sizes_of(followed.plan.job, frames=len(followed.report.frames), pictures=study.pictures)
        values: dict[str, float | str | None] = {
            "frames": len(followed.report.frames),
            "frames made": len(followed.report.made),
        }
        return _outcome(case, followed.report.checks, values, followed.report.provenance)
    from musclefit.workflows.run import run

    done = run(case.rig_file, out=result, overrides=overrides, pictures=study.pictures, progress=Silent())
    sizes |= sizes_of(done.job, frames=1, pictures=study.pictures)
    return _outcome(case, done.report.checks, _values(done.report), done.report.provenance)


def sizes_of(job: Job, *, frames: int, pictures: bool) -> dict[str, Any]:
    """What time and memory of a case depend on."""
    return {
        "vertices": sum(len(tissue.surface.vertices) for tissue in job.anatomy),
        "tissues": len(job.anatomy),
        "landmarks": len(job.handles.names),
        "frames": frames,
        "rigid": job.rig.bones.rigid,
        "tets": job.rig.tets.enabled,
        "pictures": pictures,
    }


def _values(report: Report) -> dict[str, float | str | None]:
    side: Side = report.result
    return {
        "steps": side.steps,
        "map": side.map.claim.value,
        "mesh": "none" if side.mesh is None else side.mesh.claim.value,
        "least det J": _number(side.map.min_jacobian_determinant),
    }


def _outcome(
    case: Case, checks: tuple[Check, ...], values: dict[str, float | str | None], provenance: Mapping[str, Any]
) -> CaseOutcome:
    told = tuple(
        {
            "check": check.name,
            "value": _number(check.value),
            "limit": _number(check.limit),
            "unit": check.unit,
            "place": check.place,
            "passed": check.passed,
        }
        for check in checks
    )
    for check in checks:
        values[f"{check.name} [{check.unit}]" if check.unit else check.name] = _number(check.value)
    failed = [check for check in checks if not check.passed]
    reason = "; ".join(
        f"{check.name} {'not measured' if math.isnan(check.value) else f'{check.value:.4g}'} {check.unit}".strip()
        + (f", limit {check.limit:.4g}" if check.limited else "")
        + (f" ({check.place})" if check.place else "")
        for check in failed
    )
    inputs = provenance.get("input_sha256", {})
    return CaseOutcome.of(
        case, OFF_LIMITS if failed else PASSED, reason=reason, values=values, checks=told, inputs=dict(inputs)
    )


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
