"""The command that fits a template's skin to a scan."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json
from musclefit.errors import InputError
from musclefit.workflows.progress import TimedStages

PASSED, FAILED = 0, 1

UNSURE = 1.3
"""A second way to lie that fits less than so many times as badly is told."""


def fit_body(
    template: Annotated[Path, Parameter(help="The template's skin, closed: PLY, STL, OBJ, VTP.")],
    scan: Annotated[
        Path, Parameter(help="The scan: a surface in a similar pose, anywhere in space; holes are allowed.")
    ],
    out: Annotated[Path, Parameter(help="New or empty folder for cage, targets, rig, surfaces and report.")],
    /,
    *,
    cage: Annotated[
        Path | None, Parameter(name="--cage", help="Cage of the template; without it, one is made.")
    ] = None,
    vertices: Annotated[
        int, Parameter(name="--vertices", help="Number of vertices of a cage that is made.", show_default=True)
    ] = 800,
    anatomy: Annotated[
        tuple[str, ...],
        Parameter(name="--anatomy", help="Further surfaces for the rig, or a pattern for them. May be repeated."),
    ] = (),
    units: Annotated[
        Literal["mm", "cm", "m"], Parameter(name="--units", help="Length unit of the template.", show_default=True)
    ] = "mm",
    scan_units: Annotated[
        Literal["mm", "cm", "m"], Parameter(name="--scan-units", help="Length unit of the scan.", show_default=True)
    ] = "mm",
    template_landmarks: Annotated[
        Path | None, Parameter(name="--template-landmarks", help="Landmarks on the template, matched by name with")
    ] = None,
    scan_landmarks: Annotated[Path | None, Parameter(name="--scan-landmarks", help="landmarks on the scan.")] = None,
    frame: Annotated[str, Parameter(name="--frame", help="The template's frame, for the rig.")] = "",
    median_mm: Annotated[
        float, Parameter(name="--median-mm", help="Largest median distance of the scan that passes.", show_default=True)
    ] = 2.0,
    most_mm: Annotated[
        float,
        Parameter(
            name="--most-mm", help="Largest distance that passes for 95 % of the scan's area.", show_default=True
        ),
    ] = 8.0,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Fit a template's skin to a body scan of any triangulation, and write the cage that deforms the anatomy to match.

    Exit code 1: the fit is written, and the scan is farther from the skin than the limits.
    """
    from musclefit.workflows.fit_body import fit_body as fit
    from musclefit.workflows.fit_body import rig_of

    if (template_landmarks is None) != (scan_landmarks is None):
        raise InputError("landmarks come in two files: give both --template-landmarks and --scan-landmarks, or none")
    pair = None if template_landmarks is None or scan_landmarks is None else (template_landmarks, scan_landmarks)
    with TimedStages(shown=not quiet) as stages:
        found = fit(
            template,
            scan,
            out,
            cage=cage,
            vertices=vertices,
            anatomy=anatomy,
            units=units,
            scan_units=scan_units,
            landmarks=pair,
            frame=frame,
            median_mm=median_mm,
            most_mm=most_mm,
            progress=stages,
        )
    if json:
        print_json(found.to_json())
    elif not quiet:
        for finding in found.findings:
            print(finding.message, file=sys.stderr)
        print(f"wrote {out}: {found.said()}")
        print(f"the scan is {found.fit.size:.3g} times the template as a whole; cage of {len(found.fit.cage.vertices)}")
        if found.fit.rival is not None and found.fit.rival < UNSURE:
            print(
                f"the scan also fits in another orientation ({found.fit.rival:.2f} times the distance): check whether "
                "front is front, or give three landmarks"
            )
        if found.fit.turned:
            print("the scan was inside out and was reversed")
        if found.fit.crossings:
            print(f"{found.fit.crossings} pairs of triangles of the target cage cross: inspect {out}/cage_target.ply")
        if not found.passed:
            print(
                f"FAILED: colour {out}/scan.vtp by distance_mm. Remove what is not body; give landmarks where limbs "
                "are matched wrongly; give the cage more vertices where details are missed"
            )
        print(f"next: musclefit run {rig_of(out)}")
    return PASSED if found.passed else FAILED
