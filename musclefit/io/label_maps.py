"""Segmentations -> anatomies: a NIfTI label map and a table of names; knows files, not how surfaces are made."""

from __future__ import annotations

from pathlib import Path

from musclefit.anatomy.label_surfaces import LabelName, label_anatomy, label_fits
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame
from musclefit.io.anatomy import ReadAnatomy
from musclefit.io.formats.label_images import read_label_image
from musclefit.io.label_names import read_names
from musclefit.progress import Progress


def read_label_names(path: Path) -> tuple[LabelName, ...]:
    """Read a table of labels, see `musclefit.io.label_names.read_names`, that says a kind for each.

    Raises
    ------
    InputError
        What `read_names` refuses, or a label without a kind.
    """
    names = []
    for row in read_names(path):
        if row.kind is None:
            raise InputError(
                f"{path}: label {row.value} ({row.name!r}) has no kind; add the column kind: {', '.join(TissueKind)}"
            )
        names.append(LabelName(row.value, row.name, row.kind))
    return tuple(names)


def read_label_anatomy(image: Path, names: Path, *, frame: Frame, progress: Progress | None = None) -> ReadAnatomy:
    """The layered surfaces of a segmentation, as 3D Slicer or TotalSegmentator export it.

    Parameters
    ----------
    image : Path
        NIfTI or NRRD label map.
    names : Path
        See `read_label_names`.
    frame : Frame
        Of the surfaces.

    Raises
    ------
    InputError, MeshError
        See `read_label_names`, `musclefit.io.formats.label_images.read_label_image` and
        `musclefit.anatomy.label_surfaces.label_anatomy`.
    """
    stored = read_label_image(image)
    if len(stored.layers) != 1:
        raise InputError(f"{image}: holds {len(stored.layers)} volumes; expected one label map, or use from-labels")
    made = label_anatomy(
        stored.layers[0], stored.grid, names=read_label_names(names), frame=frame, source=str(image), progress=progress
    )
    _, off = label_fits(made.anatomy, made, stored.grid, frame=frame)
    return ReadAnatomy(made.anatomy, (*made.findings, *off), {image.name: stored.sha256})
