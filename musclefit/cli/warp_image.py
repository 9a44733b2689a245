"""The command that takes an image of the body along with a rig's deformation."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from musclefit.cli.progress import TimedStages
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame, Interpolation

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
    outside: Annotated[float, Parameter(help="Value of what comes from beyond the image.")] = 0.0,
    like: Annotated[
        Path | None, Parameter(name="--like", help="Image whose grid the result has; without it, that of the image.")
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
    set: Annotated[  # noqa: A002 (the option's name)
        tuple[str, ...], Parameter(name="--set", help="key=value, as in the rig file; may be given again.")
    ] = (),
    quiet: Annotated[bool, Parameter(name="--quiet", negative="", help="Print nothing but errors.")] = False,
) -> int:
    """Take an image of the body along with a rig's deformation, through its exact inverse."""
    import numpy as np

    from musclefit.io.formats.nifti import check_images_writable, read_volume, write_displacements, write_volume
    from musclefit.io.rig_names import find_rig
    from musclefit.io.rigs import read_rig
    from musclefit.pipeline.deformers import deform
    from musclefit.pipeline.images import jacobian_map
    from musclefit.pipeline.images import warp_image as warped_image

    written = [path for path in (out, displacements, jacobian) if path is not None]
    check_images_writable(written, given=[path for path in (image, like) if path is not None])
    with TimedStages(shown=not quiet) as stages:
        volume = read_volume(image)
        _require_interpolation(image, whole=volume.holds_labels, interpolation=interpolation)
        onto = volume.grid if like is None else read_volume(like).grid
        job = read_rig(find_rig(rig), overrides=set, progress=stages)
        _require_frame(job.anatomy.frame, frame)
        deformation = deform(job, job.anatomy.vertices(), progress=stages).deformation.require()
        vectors = None if displacements is None else np.empty((*onto.shape, 3), dtype=np.float32)
        warped = warped_image(
            volume.values,
            volume.grid,
            deformation=deformation,
            frame=frame,
            onto=onto,
            interpolation=interpolation,
            outside=outside,
            displacements=vectors,
            progress=stages,
        )
        determinants = None
        if jacobian is not None:
            determinants = jacobian_map(deformation, volume.grid, frame=frame, progress=stages)
        # All that can fail is done: the displacements refuse voxels without origin, so they are written first.
        if displacements is not None and vectors is not None:
            write_displacements(displacements, vectors, onto, description="deformed body to rest, mm, LPS+")
        if jacobian is not None and determinants is not None:
            write_volume(jacobian, determinants, volume.grid, description="Jacobian determinant, rest to deformed")
        write_volume(out, warped.values, onto, description=f"musclefit: {job.name}")
    if warped.unsolved:
        print(
            f"musclefit: {warped.unsolved} of {onto.count} voxels have no origin: the map is not one-to-one there, "
            "outside the body; they hold the value for outside",
            file=sys.stderr,
        )
    if not quiet:
        print("wrote " + ", ".join(str(path) for path in written))
    return PASSED


def _require_frame(stated: str, frame: Frame) -> None:
    """InputError where the rig states another frame than the one given."""
    named = {word.lower() for word in re.findall(r"\b(?:LPS|RAS)\b", stated)}
    if named and frame.value not in named:
        raise InputError(f'the rig\'s anatomy.frame is "{stated}", but --frame is {frame.value}; correct one of them')


def _require_interpolation(path: Path, *, whole: bool, interpolation: Interpolation) -> None:
    """InputError where values that cannot be labels would be treated as such."""
    if interpolation is Interpolation.NEAREST and not whole:
        raise InputError(
            f"{path} holds fractions, so it is no label map; use --interpolation linear or cubic, or store it as "
            "integers"
        )
