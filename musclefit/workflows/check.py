"""An anatomy as it is, from its files to a report: overlaps and mesh faults; nothing is moved."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError
from musclefit.io.anatomy import read_anatomy
from musclefit.io.provenance import measured
from musclefit.io.run_folder import Maker, claimed, write_inspection
from musclefit.pipeline.inspect import inspect
from musclefit.progress import Progress
from musclefit.report.model import MeshReport
from musclefit.validate.closeness import GAP, SLOT, THIN
from musclefit.validate.model import NotChecked
from musclefit.vocabulary import Unit
from musclefit.workflows.given import KindsGiven, kinds_given, paths_given, word
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Judged

FAULTS = (
    *("self-crossing", "self-touching", "non-manifold", "zero-area", "pieces", "cavities", "nested", "unused-vertices"),
    *("merged-vertices", "repeated-vertices", "repeated-faces", "turned-faces", "inside-out", "cut-polygons"),
    *("unknown-kind", "not-read"),
)
"""Findings that ``fail_on`` accepts; surfaces that are open or have no inside always fail it."""


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class Checked(Judged):
    """An anatomy that was checked: the tissues, the report, and the folder it was written to or None."""

    anatomy: Anatomy
    report: MeshReport
    folder: Path | None = None

    def said(self) -> str:
        """Verdict and size in a line."""
        pairs = len(self.report.overlaps.pairs)
        return f"{self.report.title}: {self.report.verdict}; {len(self.report.tissues)} tissues, {pairs} overlap"

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Checks, tissues, overlapping pairs and findings."""
        return {
            "checks": self.report.checks,
            "tissues": self.report.tissues,
            "overlaps": self.report.overlaps.pairs,
            "findings": self.report.findings,
        }


def check(
    paths: str | Path | Sequence[str | Path],
    *,
    out: str | Path | None = None,
    units: Unit | str = Unit.MILLIMETRE,
    kinds: KindsGiven = (),
    fail_on: Sequence[str] = (),
    thinnest_mm: float = 0.0,
    smallest_gap_mm: float = 0.0,
    progress: Progress | None = None,
) -> Checked:
    """Report the overlaps and mesh faults of a layered anatomy as it stands.

    Parameters
    ----------
    paths : path, or sequence of path
        A folder of closed surfaces, or the files: PLY, STL, OBJ, VTP; one per tissue.
    out : path, optional
        Folder for the report; a former one there is replaced.
    units : {"mm", "cm", "m"}
        Of the files.
    kinds : mapping of name or pattern to {"skin", "muscle", "bone", "other"}
        Kinds of tissues, overriding what their file names say.
    fail_on : sequence of str
        Findings that fail the check, in addition to overlaps and surfaces without an inside: any of ``FAULTS``.
    thinnest_mm : float
        Walls of a tissue that are thinner, and slots in it that are narrower, fail the check; 0 switches this off.
    smallest_gap_mm : float
        Two tissues (other than the skin) that are closer but do not overlap fail the check; 0 switches this off.
    progress : Progress, optional

    Returns
    -------
    Checked
        The anatomy that could be read, and the report with its verdict.

    Raises
    ------
    InputError, MeshError
        Files that cannot be read, or none that can be used; a surface that cannot be used is left out and fails the
        check, as long as another one can be.
    """
    unknown = [code for code in fail_on if code not in FAULTS]
    if unknown:
        raise InputError(f"fail_on: found {unknown[0]!r}; known are {', '.join(FAULTS)}")
    for name, limit in (("thinnest_mm", thinnest_mm), ("smallest_gap_mm", smallest_gap_mm)):
        if not 0.0 <= limit < math.inf:
            raise InputError(f"{name}: found {limit:g}; give a length of at least 0 mm")
    close = (*((THIN, SLOT) if thinnest_mm else ()), *((GAP,) if smallest_gap_mm else ()))
    with claimed(None if out is None else Path(out), by=Maker.CHECK):
        unit, files = word(Unit, units, what="units"), paths_given(paths)
        with watched(progress) as stages:
            source = files[0] if len(files) == 1 and files[0].is_dir() else files
            read = read_anatomy(source, units=unit, kinds=kinds_given(kinds), progress=stages, leave_out=True)
            findings = (*read.unusable, *read.findings)
            found = inspect(
                read.anatomy,
                findings=findings,
                title=str(files[0]),
                thinnest_mm=thinnest_mm,
                smallest_gap_mm=smallest_gap_mm,
                progress=stages,
            )
        left = tuple(NotChecked(finding.subject, finding.message) for finding in read.unusable)
        overlaps = replace(found.overlaps, not_checked=(*left, *found.overlaps.not_checked))
        found = replace(found, overlaps=overlaps, fail_on=(*fail_on, *close))
        report = replace(found, **measured(stages.seconds, provenance={"input_sha256": dict(read.hashes)}))
        if out is not None:
            write_inspection(Path(out), report)
    return Checked(read.anatomy, report, None if out is None else Path(out))
