"""The command that follows a motion frame by frame."""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from musclefit.cli.options import QuietOption, SetOption
from musclefit.io.rig_names import find_rig
from musclefit.rig.motion import Interpolation
from musclefit.worker_processes import usable_processors
from musclefit.workflows.progress import TimedStages

if TYPE_CHECKING:
    from musclefit.report.sequence import SequenceReport

PASSED, FAILED = 0, 1
_TOLD = ("marker-residuals", "unused-markers", "coordinates-open", "model-turned")
"""Findings about markers that are printed; the page has all."""


def sequence(
    rig: Annotated[str, Parameter(help="A rig file that joints or transforms drive, or a built-in rig's name.")],
    motion: Annotated[
        Path | None,
        Parameter(
            help="CSV of joints' keyframes: time_s and one column per coordinate, such as elbow_deg. Where an OpenSim "
            "model drives: its .mot or .sto, or markers in a .trc or .c3d. Without it: drive.motion of the rig."
        ),
    ] = None,
    /,
    *,
    frames: Annotated[
        int,
        Parameter(
            name="--frames", help="Number of frames, evenly spaced in time. Without it: drive.frames of the rig."
        ),
    ] = 0,
    interpolation: Annotated[
        Interpolation | None,
        Parameter(
            name="--interpolation", help="Interpolation between keyframes. Without it: drive.interpolation of the rig."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        Parameter(
            name=["--out", "-o"],
            help="Folder for the frames; a run that was interrupted there goes on. Without it: musclefit-out/ and the "
            "rig's name.",
        ),
    ] = None,
    workers: Annotated[
        int, Parameter(name="--workers", help="Processes, one thread each. Without it: one per processor.")
    ] = 0,
    set: SetOption = (),  # noqa: A002 (the option's name)
    no_between: Annotated[
        bool, Parameter(name="--no-between", negative="", help="Do not check for collisions between frames.")
    ] = False,
    no_pictures: Annotated[
        bool,
        Parameter(name=("--no-pictures", "--no-film"), negative="", help="Make no film and no pictures."),
    ] = False,
    quiet: QuietOption = False,
    json: Annotated[bool, Parameter(name="--json", negative="", help="Print report.json, not a summary.")] = False,
) -> int:
    """Follow a motion: each frame is made from rest and checked; writes muscle measures, series, film and report."""
    from musclefit.workflows.sequence import sequence as follow

    folder = out if out is not None else Path("musclefit-out") / find_rig(rig).stem
    with TimedStages(shown=not quiet) as stages:
        report = follow(
            rig,
            motion,
            out=folder,
            frames=frames,
            interpolation=interpolation,
            workers=workers or usable_processors(),
            overrides=set,
            between=not no_between,
            pictures=not no_pictures,
            progress=stages,
        ).report
    if json:
        from musclefit.report.sequence import sequence_to_json

        print(json_text.dumps(sequence_to_json(report), indent=2, allow_nan=False, default=str))
        return PASSED if report.verdict == "passed" else FAILED
    if not quiet:
        _print(report, folder)
    return PASSED if report.verdict == "passed" else FAILED


def _print(report: SequenceReport, folder: Path) -> None:
    """The verdict, the checks and where everything is."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False, soft_wrap=True)
    console.print(
        Text(f"{report.verdict}: {report.title}", style="bold green" if report.verdict == "passed" else "bold red")
    )
    console.print(Text(report.resampling))
    console.print(Text(f"{len(report.made)} of {len(report.frames)} frames made, {report.certified} certified"))
    table = Table(box=None, pad_edge=False)
    for heading, justify in (("", "left"), ("check", "left"), ("value", "right"), ("limit", "right"), ("unit", "left")):
        table.add_column(heading, justify=justify)  # type: ignore[arg-type]
    table.add_column("where", justify="left", overflow="fold")
    for check in report.checks:
        said = f"{check.value:.4g}", f"{check.limit:.4g}" if check.limited else "none"
        table.add_row("ok" if check.passed else "FAIL", check.name, *said, check.unit, Text(check.place))
    console.print(table)
    for finding in report.findings:
        if finding.code in _TOLD:
            console.print(Text(f"{finding.subject}: {finding.message}"))
    for check in report.checks:
        if not check.passed:
            console.print(Text(f"next, for {check.name}: {check.next_step}"))
    console.print(Text(f"wrote {folder}"))
