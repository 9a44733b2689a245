"""The command that makes a folder of surfaces, ready for a rig, of a segmentation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from musclefit.cli.progress import TimedStages
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame

PASSED = 0


def label_surfaces(
    image: Annotated[Path, Parameter(help="NIfTI label map (.nii, .nii.gz).")],
    names: Annotated[Path, Parameter(help="CSV with the columns value, name and kind (skin, muscle, bone, other).")],
    /,
    *,
    out: Annotated[Path, Parameter(name="--out", help="Folder for one surface per label.")],
    frame: Annotated[Frame, Parameter(help="Frame of the surfaces; 3D Slicer's own are LPS.")],
    quiet: Annotated[bool, Parameter(name="--quiet", negative="", help="Print nothing but errors.")] = False,
) -> int:
    """Make the closed, layered surfaces of a segmentation, which a rig reads as its anatomy."""
    from musclefit.io.label_maps import read_label_anatomy
    from musclefit.io.run_folder import file_names, ply_bytes

    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(
            f"{out}: is not an empty folder; surfaces of former labels would mix with new ones: choose another"
        )
    with TimedStages(shown=not quiet) as stages:
        read = read_label_anatomy(image, names, frame=frame, progress=stages)
        out.mkdir(parents=True, exist_ok=True)
        called = file_names([tissue.name for tissue in read.anatomy])
        for tissue in read.anatomy:
            folder = out / tissue.kind.value
            folder.mkdir(exist_ok=True)
            (folder / f"{called[tissue.name]}.ply").write_bytes(ply_bytes(tissue.surface))
    if not quiet:
        for finding in read.findings:
            print(finding.message)
        print(f"wrote {len(read.anatomy)} surfaces to {out} ({read.anatomy.frame})")
    return PASSED
