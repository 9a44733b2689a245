"""The command that makes surfaces, joints and a rig of a segmentation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from musclefit.cli.kinds import parse_kinds
from musclefit.cli.options import JsonOption, QuietOption, print_json
from musclefit.geometry.images.grids import Frame
from musclefit.io.formats.nifti import HeaderForm
from musclefit.workflows.progress import TimedStages

PASSED, FAILED = 0, 1


def from_labels(
    source: Annotated[
        Path,
        Parameter(
            help="Label map or stack of masks (.nii, .nii.gz, .nrrd, .seg.nrrd), or a folder of one mask per tissue."
        ),
    ],
    out: Annotated[Path, Parameter(help="New or empty folder for surfaces, joints, rig and report.")],
    /,
    *,
    names: Annotated[
        Path | None,
        Parameter(
            help="Table of value, name and kind (.csv, .tsv, .json, .ctbl). Without it, headers or file names count."
        ),
    ] = None,
    kind: Annotated[
        tuple[str, ...],
        Parameter(name="--kind", help="name=kind: skin, other, muscle or bone; the name may be a pattern. Repeatable."),
    ] = (),
    frame: Annotated[Frame, Parameter(help="Frame of the surfaces; 3D Slicer's own are LPS.", show_default=True)] = (
        Frame.LPS
    ),
    header_form: Annotated[
        HeaderForm,
        Parameter(help="Which transform of a NIfTI header to use where its two disagree.", show_default=True),
    ] = HeaderForm.AGREED,
    within_mm: Annotated[
        float, Parameter(help="Surfaces of two bones within this distance belong to their joint.", show_default=True)
    ] = 5.0,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Make surfaces, joints and a ready-to-run rig from a segmentation, with a report of every step."""
    from musclefit.workflows.from_labels import from_labels as make

    with TimedStages(shown=not quiet) as stages:
        made = make(
            source,
            out,
            names=names,
            kinds=parse_kinds(kind),
            frame=frame,
            header_form=header_form,
            within_mm=within_mm,
            progress=stages,
        )
    if json:
        print_json(made.to_json())
    elif not quiet:
        for finding in made.findings:
            print(finding.message)
        for one in made.joints:
            print(f"{one.joint.name}: {one.fit.said()}; {one.fit.agreement()}")
        print(f"{made.said()}: {out}")
        ready = f"next: musclefit run {out / 'rig.toml'}"
        print(ready if made.joints else "no joint was fitted, so no rig was written; next: musclefit init")
    return PASSED if made.passed else FAILED
