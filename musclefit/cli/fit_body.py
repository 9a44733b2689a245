"""The command that fits a template's skin to a scan, or to measures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json
from musclefit.errors import InputError
from musclefit.workflows.progress import TimedStages

PASSED, FAILED = 0, 1

MEDIAN_MM, MOST_MM = 2.0, 8.0
MEASURES = (".toml", ".json", ".csv")
"""Endings of files of measures; no scan has one of them."""

UNSURE = 1.3
"""A second way to lie that fits less than so many times as badly is told."""


def fit_body(
    template: Annotated[Path, Parameter(help="The template's skin, closed: PLY, STL, OBJ, VTP.")],
    scan: Annotated[
        Path,
        Parameter(
            help="The scan: a surface in a similar pose, anywhere in space; holes are allowed. Or measures instead: "
            "stature, girths, lengths with their units (.toml, .json, .csv)."
        ),
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
        Path | None,
        Parameter(
            name="--template-landmarks",
            help="Landmarks on the template: matched by name with those on the scan, or named by the measures.",
        ),
    ] = None,
    scan_landmarks: Annotated[
        Path | None, Parameter(name="--scan-landmarks", help="Landmarks on the scan, matched by name.")
    ] = None,
    up: Annotated[
        Literal["x", "y", "z", "-x", "-y", "-z"],
        Parameter(name="--up", help="The axis from feet to head, for measures.", show_default=True),
    ] = "z",
    frame: Annotated[str, Parameter(name="--frame", help="The template's frame, for the rig.")] = "",
    median_mm: Annotated[
        float, Parameter(name="--median-mm", help="Largest median distance of the scan that passes.", show_default=True)
    ] = MEDIAN_MM,
    most_mm: Annotated[
        float,
        Parameter(
            name="--most-mm", help="Largest distance that passes for 95 % of the scan's area.", show_default=True
        ),
    ] = MOST_MM,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Fit a template's skin to a body scan, or to measures, and write the cage that deforms the anatomy to match.

    Exit code 1: the fit is written, and the scan is farther from the skin than the limits.
    """
    if scan.suffix.lower() in MEASURES:
        scans_only = {
            "--scan-units": scan_units != "mm",
            "--scan-landmarks": scan_landmarks is not None,
            "--median-mm": median_mm != MEDIAN_MM,
            "--most-mm": most_mm != MOST_MM,
        }
        for option in (option for option, given in scans_only.items() if given):
            raise InputError(f"{option}: is for scans, and {scan} holds measures; leave it out")
        return _fit_measures(
            template,
            scan,
            out,
            quiet=quiet,
            json=json,
            landmarks=template_landmarks,
            up=up,
            cage=cage,
            vertices=vertices,
            anatomy=anatomy,
            units=units,
            frame=frame,
        )
    if up != "z":
        raise InputError(f"--up: is for measures, and {scan} is a scan; leave it out")
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


def _fit_measures(template: Path, measures: Path, out: Path, *, quiet: bool, json: bool, **options: Any) -> int:
    """Fit to measures, and print each before, wanted and reached."""
    from musclefit.workflows.fit_body import rig_of
    from musclefit.workflows.fit_measures import fit_measures as fit

    with TimedStages(shown=not quiet) as stages:
        found = fit(template, measures, out, progress=stages, **options)
    if json:
        print_json(found.to_json())
    elif not quiet:
        for finding in found.findings:
            print(finding.message, file=sys.stderr)
        print(f"wrote {out}: {found.said()}")
        for row in found.measures():
            print(
                f"{row['name']}: {row['before']:.5g} {row['unit']}, wanted {row['wanted']:.5g}, is {row['reached']:.5g}"
            )
        if found.fit.crossings:
            print(f"{found.fit.crossings} pairs of triangles of the target cage cross: inspect {out}/cage_target.ply")
        print(f"next: musclefit run {rig_of(out)}")
    return PASSED
