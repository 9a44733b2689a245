"""Dirty or overlapping surfaces, from their files to repaired ones with a report of all that was changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from musclefit.anatomy.model import Anatomy
from musclefit.anatomy.repair.records import RepairSettings
from musclefit.anatomy.repair.resolutions import Choice, Rule
from musclefit.errors import InputError
from musclefit.io.provenance import measured
from musclefit.io.repairs import check_target, claimed_target, read_raw, tetrahedra, write_repair
from musclefit.pipeline.repair import repair as repaired
from musclefit.progress import Progress
from musclefit.report.repairs import RepairReport
from musclefit.vocabulary import Unit
from musclefit.workflows.given import KindsGiven, kinds_given, word
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Judged

DEFAULTS = RepairSettings()


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class Repair(Judged):
    """A repair that is done: the tissues, the report, and the files written."""

    anatomy: Anatomy
    report: RepairReport
    written: tuple[Path, ...] = ()

    def said(self) -> str:
        """Verdict and size in a line."""
        changed = sum(bool(surface.changes) for surface in self.report.surfaces)
        return f"{self.report.title}: {self.report.verdict}; {changed} of {len(self.report.surfaces)} surfaces changed"

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Checks, surfaces, and what was cut and taken from whom."""
        resolved = self.report.resolved
        surfaces = [
            {
                "name": one.name,
                "way": one.way.value,
                "largest_mm": one.deviation.largest_mm,
                "volume_before_mm3": one.volume_before_mm3,
                "volume_after_mm3": one.volume_after_mm3,
            }
            for one in self.report.surfaces
        ]
        return {
            "checks": self.report.checks,
            "surfaces": surfaces,
            "pairs": () if resolved is None else resolved.pairs,
            "findings": self.report.findings,
        }


def repair(
    source: str | Path,
    out: str | Path | None = None,
    *,
    resolve: Rule | str = Rule.NONE,
    rule: Choice | str = Choice.LEAST_LOSS,
    clearance_mm: float = DEFAULTS.clearance_mm,
    max_change_percent: float = DEFAULTS.max_change_percent,
    limit_mm: float = DEFAULTS.limit_mm,
    thicken_mm: float = DEFAULTS.thicken_mm,
    stray_percent: float = DEFAULTS.stray_percent,
    local_only: bool = False,
    units: Unit | str = Unit.MILLIMETRE,
    kinds: KindsGiven = (),
    write: bool = True,
    progress: Progress | None = None,
) -> Repair:
    """Close holes, remove doubled, flipped and crossing faces, stray pieces, unused vertices and, if asked, overlaps.

    Parameters
    ----------
    source : path
        A surface file (PLY, STL, OBJ, VTP), or a folder of them.
    out : path, optional
        Folder for the repaired surfaces and report.json; or, for one file, a .ply. Without it nothing is written.
    resolve : {"none", "priority", "split"}
        How to remove overlaps between tissues.
    rule : {"least-loss", "smaller", "any-kind"}
        Which of two tissues of one kind gives up their overlap.
    clearance_mm, max_change_percent, limit_mm, thicken_mm, stray_percent : float
        See `RepairSettings`.
    local_only : bool
        Whether never to rebuild a whole surface where local repair fails.
    units : {"mm", "cm", "m"}
        Of the files; output is in mm.
    kinds : mapping of name or pattern to kind
    write : bool
        Whether to write the result; otherwise the target is checked and the repair is done all the same.
    progress : Progress, optional

    Returns
    -------
    Repair
        The repaired tissues, in mm; the report of each change, with its verdict; and the files written.

    Raises
    ------
    InputError, MeshError
        Files that cannot be read, a target that cannot be written, or a surface without an inside.
    """
    taking, choosing = word(Rule, resolve, what="resolve"), word(Choice, rule, what="rule")
    if taking is Rule.NONE and (choosing is not Choice.LEAST_LOSS or clearance_mm != DEFAULTS.clearance_mm):
        raise InputError(
            "rule and clearance-mm say how overlaps are taken away; add --resolve priority or split (in Python: "
            'resolve="priority")'
        )
    settings = RepairSettings(
        limit_mm=limit_mm,
        thicken_mm=thicken_mm,
        stray_percent=stray_percent,
        clearance_mm=clearance_mm,
        max_change_percent=max_change_percent,
    )
    if out is not None:
        check_target(Path(source), Path(out))
    unit = word(Unit, units, what="units")
    with claimed_target(Path(source), None if out is None or not write else Path(out)):
        with watched(progress) as stages:
            files = read_raw(Path(source), units=unit, kinds=kinds_given(kinds), progress=stages)
            result = repaired(
                files.tissues,
                settings=settings,
                rule=taking,
                choice=choosing,
                filler=None if local_only else tetrahedra,
                title=str(source),
                findings=files.findings,
                progress=stages,
            )
        known = measured(stages.seconds, provenance={"input_sha256": dict(files.hashes)})
        result = replace(result, report=replace(result.report, **known))
        written = () if out is None or not write else write_repair(Path(out), result, files=files)
    return Repair(result.anatomy, result.report, written)
