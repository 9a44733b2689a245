"""The command that repairs surfaces and takes overlaps away, and says all that it changed."""

from __future__ import annotations

import json as json_text
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table
from rich.text import Text

from musclefit.cli.options import QuietOption
from musclefit.workflows.progress import TimedStages

if TYPE_CHECKING:
    from musclefit.anatomy.repair.records import Repaired
    from musclefit.anatomy.repair.resolutions import Resolved
    from musclefit.report.repairs import RepairReport

PASSED, FAILED = 0, 1

WIDTH = 200
"""Columns of the table where there is no terminal."""

CLEARANCE_MM = 0.1
"""Of `musclefit.anatomy.repair.records.RepairSettings`, which takes too long to import for a line of help."""

PAIRS_SHOWN = 20
"""Overlapping pairs in the terminal; all are in the report."""


def repair(
    source: Annotated[Path, Parameter(help="A surface file (PLY, STL, OBJ, VTP), or a folder of them.")],
    out: Annotated[Path, Parameter(help="Folder for the repaired surfaces and report.json; or, for one file, a .ply.")],
    /,
    *,
    resolve: Annotated[
        Literal["none", "priority", "split"],
        Parameter(
            name="--resolve",
            help="Remove overlaps between tissues, and leave a clearance. priority: one of the two keeps the shared "
            "volume, bone before muscle before other, then by --rule; split: tissues of one kind divide it halfway.",
            show_default=True,
        ),
    ] = "none",
    rule: Annotated[
        Literal["least-loss", "smaller", "any-kind"],
        Parameter(
            name="--rule",
            help="Which of two tissues of one kind gives up their overlap. least-loss: the one that loses the smaller "
            "share of its volume, unless only that one would exceed --max-change-percent or fall apart; smaller: the "
            "larger one; any-kind: least-loss across kinds too.",
            show_default=True,
        ),
    ] = "least-loss",
    clearance_mm: Annotated[
        float,
        Parameter(name="--clearance-mm", help="Distance that --resolve leaves between tissues.", show_default=True),
    ] = CLEARANCE_MM,
    max_change_percent: Annotated[
        float,
        Parameter(
            name="--max-change-percent",
            help="Change of a tissue's volume, either way, beyond which the repair fails.",
            show_default=True,
        ),
    ] = 5.0,
    limit_mm: Annotated[
        float, Parameter(name="--limit-mm", help="Largest distance from the original, either way.", show_default=True)
    ] = 0.3,
    thicken_mm: Annotated[
        float, Parameter(name="--thicken-mm", help="Thickness to give to open sheets; 0 refuses them.")
    ] = 0.0,
    stray_percent: Annotated[
        float,
        Parameter(name="--stray-percent", help="Pieces below this share of the volume are removed.", show_default=True),
    ] = 0.01,
    local_only: Annotated[
        bool,
        Parameter(name="--local-only", negative="", help="Never rebuild a whole surface where local repair fails."),
    ] = False,
    units: Annotated[
        Literal["mm", "cm", "m"],
        Parameter(name="--units", help="Length unit of the input files; output is in mm.", show_default=True),
    ] = "mm",
    kind: Annotated[
        tuple[str, ...],
        Parameter(name="--kind", help="name=kind: what a tissue is, overriding what its file name says."),
    ] = (),
    dry_run: Annotated[
        bool, Parameter(name="--dry-run", negative="", help="Repair and report, but write nothing.")
    ] = False,
    quiet: QuietOption = False,
    json: Annotated[bool, Parameter(name="--json", negative="", help="Print the report as JSON.")] = False,
) -> int:
    """Repair surfaces (holes, doubled, flipped and crossing faces, stray pieces) and overlaps, and report each change.

    Exit code 1 if a surface is not valid, is farther from the original than the limit, changed too much in volume or
    fell apart, or if overlaps remain; everything is written all the same.
    """
    from musclefit.cli.kinds import parse_kinds
    from musclefit.report.repairs import repair_json
    from musclefit.workflows.repair import repair as mend

    with TimedStages(shown=not quiet) as stages:
        result = mend(
            source,
            out,
            write=not dry_run,
            resolve=resolve,
            rule=rule,
            clearance_mm=clearance_mm,
            max_change_percent=max_change_percent,
            limit_mm=limit_mm,
            thicken_mm=thicken_mm,
            stray_percent=stray_percent,
            local_only=local_only,
            units=units,
            kinds=parse_kinds(kind),
            progress=stages,
        )
    written = result.written
    if json:
        print(json_text.dumps(repair_json(result.report), indent=2, allow_nan=False))
    elif not quiet:
        print_repair(result.report, where=_where(out, written))
    return PASSED if result.report.verdict == "passed" else FAILED


def print_repair(report: RepairReport, *, where: str) -> None:
    """Verdict, every surface that was changed with its changes, the pairs, and what breaks a limit."""
    width = None if sys.stdout.isatty() else WIDTH
    console = Console(highlight=False, soft_wrap=True, width=width)
    style = "bold green" if report.verdict == "passed" else "bold red"
    console.print(Text.assemble((report.verdict.upper(), style), f"  {report.title}"))
    changed = [s for s in report.surfaces if s.changes]
    console.print(
        Text(f"{len(report.surfaces)} surfaces, {len(report.surfaces) - len(changed)} of them left as they are")
    )
    for surface in changed:
        console.print(Text(f"{surface.name}: {surface.way.value}; had {surface.before.said()}", style="bold"))
        for change in surface.changes:
            console.print(Text(f"    {change.message}"))
    if changed:
        console.print(_distances(changed))
    for finding in report.findings:
        console.print(Text(f"note: {finding.message}"))
    if report.resolved is not None:
        _print_resolved(console, report.resolved)
    from musclefit.cli.summary import print_failed

    print_failed(console, report.checks)
    console.print(Text(where))


def _distances(changed: list[Repaired]) -> Table:
    table = Table(box=None, pad_edge=False)
    for heading in ("surface", "way", "distance", "whole", "volume before", "after", "left"):
        table.add_column(heading, justify="left" if heading in ("surface", "way", "left") else "right")
    for one in changed:
        distance = Text(f"{one.deviation.largest_mm:.3f} mm", style="" if one.within_limit else "red")
        table.add_row(
            one.name,
            one.way.value,
            distance,
            f"{one.deviation.whole_mm:.3f} mm",
            f"{one.volume_before_mm3:.6g} mm³",
            f"{one.volume_after_mm3:.6g} mm³",
            Text(one.after.said(), style="" if one.after.none else "red"),
        )
    return table


def _print_resolved(console: Console, resolved: Resolved) -> None:
    total = sum(pair.overlap_mm3 for pair in resolved.pairs)
    console.print(Text(f"{len(resolved.pairs)} overlapping pairs, {total:.6g} mm³ in all, {len(resolved.left)} left"))
    for pair in resolved.pairs[:PAIRS_SHOWN]:
        lost = f"{pair.from_a_mm3:.4g} + {pair.from_b_mm3:.4g}"
        console.print(Text(f"  {pair.overlap_mm3:10.4g} mm³ ({lost})  {pair.a} / {pair.b}: {pair.rule}"))
    if len(resolved.pairs) > PAIRS_SHOWN:
        console.print(Text(f"  ... and {len(resolved.pairs) - PAIRS_SHOWN} more, all in the report"))
    for cut in resolved.cuts:
        percent = cut.change_percent
        notes = "; ".join(change.message for change in cut.changes)
        console.print(Text(f"  {cut.name}: {percent:+.2f} % of its volume{'; ' + notes if notes else ''}"))
    _print_room(console, resolved)


def _print_room(console: Console, resolved: Resolved) -> None:
    """How far tissues are apart from each other and from themselves."""
    aimed = f"clearance of {resolved.clearance_mm:g} mm"
    if not resolved.gaps:
        console.print(Text(f"{aimed} kept between all tissues"))
    else:
        console.print(Text(f"{aimed} not reached by {len(resolved.gaps)} pairs:"))
        for gap in resolved.gaps[:PAIRS_SHOWN]:
            console.print(Text(f"  {gap.gap_mm:10.4g} mm  {gap.a} / {gap.b}"))
        if len(resolved.gaps) > PAIRS_SHOWN:
            console.print(Text(f"  ... and {len(resolved.gaps) - PAIRS_SHOWN} more, all in the report"))
    for thin in resolved.thin:
        said = f"closer to itself than half of that over {thin.area_mm2:.3g} mm² (both sides counted)"
        console.print(Text(f"  {thin.name}: {said}"))


def _where(out: Path, written: tuple[Path, ...]) -> str:
    return f"wrote {len(written)} files to {out}" if written else "dry run: nothing was written"
