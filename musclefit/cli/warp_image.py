"""The command that takes an image of the body along with a rig's deformation."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, SetOption, print_json
from musclefit.geometry.images.grids import Frame, Interpolation
from musclefit.workflows.progress import TimedStages

PASSED = 0


def warp_image(
    rig: Annotated[str, Parameter(help="A rig file, or the name of a built-in rig.")],
    image: Annotated[Path, Parameter(help="NIfTI image of the body at rest (.nii, .nii.gz).")],
    /,
    *,
    frame: Annotated[
        Frame, Parameter(help="The frame of the rig's coordinates; surfaces from 3D Slicer are LPS, MNI space is RAS.")
    ],
    out: Annotated[Path, Parameter(name="--out", help="The image on the deformed body.")],
    interpolation: Annotated[
        Interpolation, Parameter(help="Linear and cubic are for intensities, nearest for label maps.")
    ] = Interpolation.LINEAR,
    outside: Annotated[float, Parameter(help="Value of voxels that come from beyond the image.")] = 0.0,
    like: Annotated[
        Path | None, Parameter(name="--like", help="Image whose grid the result uses; without it, the image's own.")
    ] = None,
    displacements: Annotated[
        Path | None,
        Parameter(
            name="--displacements", help="Also write the inverse displacement field, as ITK and 3D Slicer read it."
        ),
    ] = None,
    jacobian: Annotated[
        Path | None, Parameter(name="--jacobian", help="Also write the Jacobian determinant at the image's voxels.")
    ] = None,
    set: SetOption = (),  # noqa: A002 (the option's name)
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Warp an image of the body by a rig's deformation, resampled through the exact inverse."""
    from musclefit.workflows.warp_image import warp_image as warp

    with TimedStages(shown=not quiet) as stages:
        warped = warp(
            rig,
            image,
            out,
            frame=frame,
            interpolation=interpolation,
            outside=outside,
            like=like,
            displacements=displacements,
            jacobian=jacobian,
            overrides=set,
            progress=stages,
        )
    if warped.unsolved:
        print(
            f"musclefit: {warped.unsolved} of {warped.values.size} voxels have no preimage: the map is not one-to-one "
            "there, outside the body; they hold the value for outside",
            file=sys.stderr,
        )
    if json:
        files = {"image": out, "displacements": displacements, "jacobian": jacobian}
        named = {name: None if path is None else str(path) for name, path in files.items()}
        print_json({**named, "voxels": warped.values.size, "unsolved": warped.unsolved})
    elif not quiet:
        print("wrote " + ", ".join(str(path) for path in (out, displacements, jacobian) if path is not None))
    return PASSED
