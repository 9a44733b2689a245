"""An image of the body through a rig's deformation, from NIfTI to NIfTI."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame, Interpolation
from musclefit.io.formats.nifti import check_images_writable, read_volume, write_displacements, write_volume
from musclefit.io.rig_names import RigGiven
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform
from musclefit.pipeline.images import WarpedImage, jacobian_map
from musclefit.pipeline.images import warp_image as warped_image
from musclefit.progress import Progress
from musclefit.workflows.frames import frame_of
from musclefit.workflows.given import word
from musclefit.workflows.progress import watched


def warp_image(
    rig: RigGiven,
    image: str | Path,
    out: str | Path,
    *,
    frame: Frame | str,
    interpolation: Interpolation | str = Interpolation.LINEAR,
    outside: float = 0.0,
    like: str | Path | None = None,
    displacements: str | Path | None = None,
    jacobian: str | Path | None = None,
    overrides: Sequence[str] = (),
    progress: Progress | None = None,
) -> WarpedImage:
    """Warp an image of the body by a rig's deformation, resampled through its exact inverse.

    Parameters
    ----------
    rig : str, path or mapping
        See `musclefit.run`.
    image, out : path
        NIfTI (.nii, .nii.gz): the body at rest, and the image on the deformed body.
    frame : {"lps", "ras"}
        Of the rig's coordinates; surfaces from 3D Slicer are LPS, MNI space is RAS.
    interpolation : {"linear", "cubic", "nearest"}
        Linear and cubic are for intensities, nearest for label maps.
    outside : float
        Value of what comes from beyond the image.
    like : path, optional
        Image whose grid the result has; without it, that of the image.
    displacements, jacobian : path, optional
        Where to write the inverse displacement field too, as ITK and 3D Slicer read it, and the Jacobian determinant
        at the image's voxels.
    overrides : sequence of str
        ``key=value`` each.
    progress : Progress, optional

    Returns
    -------
    WarpedImage
        Its ``unsolved`` voxels have no origin: the map is not one-to-one there, outside the body.

    Raises
    ------
    InputError, RigError, NotConvergedError
        Files that cannot be read or written, another frame than the rig states, fractions taken for labels, or a rig
        that does not reach its destination.
    """
    image = Path(image)
    written = [Path(path) for path in (out, displacements, jacobian) if path is not None]
    check_images_writable(written, given=[Path(path) for path in (image, like) if path is not None])
    into, between = word(Frame, frame, what="frame"), word(Interpolation, interpolation, what="interpolation")
    with watched(progress) as stages:
        volume = read_volume(image)
        _require_interpolation(image, whole=volume.holds_labels, interpolation=between)
        onto = volume.grid if like is None else read_volume(Path(like)).grid
        job = read_rig(rig, overrides=overrides, progress=stages)
        frame_of(job.anatomy.frame, into)
        deformation = deform(job, job.anatomy.vertices(), progress=stages).deformation.require()
        vectors = None if displacements is None else np.empty((*onto.shape, 3), dtype=np.float32)
        warped = warped_image(
            volume.values,
            volume.grid,
            deformation=deformation,
            frame=into,
            onto=onto,
            interpolation=between,
            outside=outside,
            displacements=vectors,
            progress=stages,
        )
        determinants = None
        if jacobian is not None:
            determinants = jacobian_map(deformation, volume.grid, frame=into, progress=stages)
        # All that can fail is done: the displacements refuse voxels without origin, so they are written first.
        if displacements is not None and vectors is not None:
            write_displacements(Path(displacements), vectors, onto, description="deformed body to rest, mm, LPS+")
        if jacobian is not None and determinants is not None:
            write_volume(
                Path(jacobian), determinants, volume.grid, description="Jacobian determinant, rest to deformed"
            )
        write_volume(Path(out), warped.values, onto, description=f"musclefit: {job.name}")
    return warped


def _require_interpolation(path: Path, *, whole: bool, interpolation: Interpolation) -> None:
    """InputError where values that cannot be labels would be treated as such."""
    if interpolation is Interpolation.NEAREST and not whole:
        raise InputError(
            f"{path} holds fractions, so it is not a label map; use --interpolation linear or cubic, or store it as "
            "integers"
        )
