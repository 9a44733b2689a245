"""What a run or an inspection found, in a screenful."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from musclefit.anatomy.findings import Finding
from musclefit.report.comparison import Cell, compare
from musclefit.report.model import MeshReport, Report
from musclefit.validate.model import Check


def print_run(report: Report, *, folder: Path) -> None:
    """The verdict, the limits, and the result beside what it is compared with."""
    console = Console(highlight=False, soft_wrap=True)
    console.print(_verdict(report.verdict, report.title))
    steps = "1 step" if report.result.steps == 1 else f"{report.result.steps} steps"
    console.print(Text(f"{report.result.method}; {steps}; {report.result.status}"))
    console.print(Text(f"map: {report.result.map.claim.value}; mesh: {_mesh_claim(report)}"))
    table = Table(box=None, pad_edge=False)
    beside = [
        name for name, side in (("paper's loop", report.paper_loop), ("one shot", report.baseline)) if side is not None
    ]
    table.add_column("")
    for heading in ("result", *beside):
        table.add_column(heading, justify="right")
    table.add_column("unit")
    for row in compare(report):
        others = [cell for cell in (row.paper_loop, row.baseline) if cell is not None]
        table.add_row(row.name, _cell(row.result), *map(_cell, others), row.unit)
    console.print(table)
    console.print(Text(f"limits {report.limits_in_words}"))
    print_failed(console, report.checks)
    console.print(_said_written(folder))


def print_inspection(report: MeshReport, *, folder: Path | None) -> None:
    """The verdict, what was found in the surfaces, and the overlapping pairs."""
    console = Console(highlight=False, soft_wrap=True)
    console.print(_verdict(report.verdict, report.title))
    triangles = sum(t.triangles for t in report.tissues)
    console.print(Text(f"{len(report.tissues)} tissues, {triangles} triangles, {len(report.findings)} findings"))
    for finding in report.findings[:20]:
        said = finding.message.removeprefix(f"{finding.subject}: ")
        console.print(Text(f"  {finding.subject}: {said} [{finding.code}]"))
    if len(report.findings) > 20:
        console.print(Text(f"  ... and {len(report.findings) - 20} more, all in the report"))
    for codes, next_step in _next_by_code(report.findings):
        console.print(Text(f"  next, for {', '.join(codes)}: {next_step}"))
    console.print(Text(f"{len(report.overlaps.pairs)} overlapping pairs, {report.overlap_total_mm3:.6g} mm³ in all"))
    for pair in report.overlaps.pairs[:20]:
        console.print(Text(f"  {pair.rest_mm3:12.4g} mm³  {pair.a} / {pair.b}"))
    if len(report.overlaps.pairs) > 20:
        console.print(Text(f"  ... and {len(report.overlaps.pairs) - 20} more, all in the report"))
    print_failed(console, report.checks)
    if folder is not None:
        console.print(_said_written(folder))


def _said_written(folder: Path) -> Text:
    known = ("report.html", "report.json", "surfaces", "tets.vtu", "pictures", "points")
    return Text(f"written to {folder}: {', '.join(name for name in known if (folder / name).exists())}")


def _verdict(verdict: str, title: str) -> Text:
    return Text.assemble((verdict.upper(), "bold green" if verdict == "passed" else "bold red"), f"  {title}")


def _mesh_claim(report: Report) -> str:
    mesh = report.result.mesh
    if mesh is None:
        return "no tetrahedra"
    told = f"{mesh.claim.value} ({mesh.note})" if mesh.note else mesh.claim.value
    cut = mesh.refinement
    if cut is None:
        return told
    wrong = f"{cut.inverted_before} tets had come out inverted" if cut.inverted_before else "its boundary had crossed"
    rounds = "1 round" if cut.rounds == 1 else f"{cut.rounds} rounds"
    stopped = f"; ended by {cut.stopped}" if cut.stopped else ""
    done = f"{cut.edges_split} edges split in {rounds}" if cut.rounds else ""
    if cut.moving_rounds:
        farthest = max((far for _, _, far in cut.moved_aside), default=0.0)
        moved = f"vertices moved off the map by up to {farthest:.3g} mm in {cut.moving_rounds} rounds"
        if cut.left_out:
            moved += f" and {cut.left_out} tets of filler ({cut.left_out_mm3:.4g} mm³) left out"
        done = f"{done}, {moved}" if done else moved
    return f"{told}; {done}, for {wrong}{stopped}"


def print_failed(console: Console, checks: tuple[Check, ...]) -> None:
    """Every failed check with its limit and place, and what to do next."""
    for check in checks:
        if not check.passed:
            place = f" ({check.place})" if check.place else ""
            value = "not measured" if math.isnan(check.value) else f"{check.value:.4g}"
            limit = f", limit {check.limit:.4g}" if check.limited else ""
            console.print(Text(f"failed: {check.name} {value} {check.unit}{limit}{place}"))
            console.print(Text(f"  next: {check.next_step}"))


def _next_by_code(findings: Iterable[Finding]) -> list[tuple[list[str], str]]:
    """Each next step once, with the codes of the findings that it is for."""
    codes: dict[str, dict[str, None]] = {}
    for found in findings:
        if found.next_step:
            codes.setdefault(found.next_step, {})[found.code] = None
    return [(list(of), next_step) for next_step, of in codes.items()]


def _cell(cell: Cell) -> Text:
    """A number, red where it breaks its limit."""
    if cell.value is None:
        return Text("-")
    text = "not measured" if math.isnan(cell.value) else f"{cell.value:.4g}"
    return Text(text, style="red" if cell.passed is False else "")
