"""A segmentation, from a label map and its names to a folder of surfaces that a rig reads as its anatomy."""

from __future__ import annotations

from pathlib import Path

from musclefit.geometry.images.grids import Frame
from musclefit.io.anatomy import ReadAnatomy
from musclefit.io.label_maps import read_label_anatomy
from musclefit.io.run_folder import file_names, ply_bytes, require_new_folder, write_new_folder
from musclefit.progress import Progress
from musclefit.workflows.given import word
from musclefit.workflows.progress import watched


def label_surfaces(
    image: str | Path,
    names: str | Path,
    out: str | Path | None = None,
    *,
    frame: Frame | str,
    progress: Progress | None = None,
) -> ReadAnatomy:
    """Make the closed, layered surfaces of a segmentation, which a rig reads as its anatomy.

    Parameters
    ----------
    image : path
        NIfTI label map (.nii, .nii.gz).
    names : path
        CSV with the columns value, name and kind (skin, muscle, bone, other).
    out : path, optional
        New or empty folder for one surface per label, in a folder for each kind.
    frame : {"lps", "ras"}
        Of the surfaces; 3D Slicer's own are LPS.
    progress : Progress, optional

    Returns
    -------
    ReadAnatomy
        The surfaces, in mm, what was found in the label map, and the hashes of its files.

    Raises
    ------
    InputError, MeshError
        Files that cannot be read, labels that make no surface, or a folder that is not empty.
    """
    if out is not None:
        require_new_folder(Path(out))
    into = word(Frame, frame, what="frame")
    with watched(progress) as stages:
        read = read_label_anatomy(Path(image), Path(names), frame=into, progress=stages)
        if out is not None:
            called = file_names([tissue.name for tissue in read.anatomy])
            write_new_folder(
                Path(out),
                {f"{t.kind.value}/{called[t.name]}.ply": ply_bytes(t.surface) for t in read.anatomy},
            )
    return read
