"""The command that makes a folder of surfaces, ready for a rig, of a segmentation."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json
from musclefit.geometry.images.grids import Frame
from musclefit.workflows.progress import TimedStages

PASSED = 0


def label_surfaces(
    image: Annotated[Path, Parameter(help="NIfTI label map (.nii, .nii.gz).")],
    names: Annotated[Path, Parameter(help="CSV with the columns value, name and kind (skin, muscle, bone, other).")],
    /,
    *,
    out: Annotated[Path, Parameter(name="--out", help="Folder for one surface per label.")],
    frame: Annotated[Frame, Parameter(help="Frame of the surfaces; 3D Slicer's own are LPS.")],
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Make closed, layered surfaces from a segmentation, for a rig to read as its anatomy."""
    from musclefit.workflows.label_surfaces import label_surfaces as make

    with TimedStages(shown=not quiet) as stages:
        read = make(image, names, out, frame=frame, progress=stages)
    if json:
        surfaces = [{"name": t.name, "kind": t.kind.value, "triangles": len(t.surface.faces)} for t in read.anatomy]
        findings = [asdict(finding) for finding in read.findings]
        print_json({"folder": str(out), "frame": read.anatomy.frame, "surfaces": surfaces, "findings": findings})
    elif not quiet:
        for finding in read.findings:
            print(finding.message)
        print(f"wrote {len(read.anatomy)} surfaces to {out} ({read.anatomy.frame})")
    return PASSED
