"""Segmentations -> anatomies: a NIfTI label map and a table of names; knows files, not how surfaces are made."""

from __future__ import annotations

import csv
from io import StringIO
from pathlib import Path

from musclefit.anatomy.label_surfaces import LabelName, label_anatomy, label_fits
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame
from musclefit.io.anatomy import ReadAnatomy
from musclefit.io.formats.label_images import read_label_image
from musclefit.io.formats.texts import read_text
from musclefit.progress import Progress

COLUMNS = ("value", "name", "kind")


def read_label_names(path: Path) -> tuple[LabelName, ...]:
    """Read a CSV table with the columns value, name and kind (skin, muscle, bone or other).

    Raises
    ------
    InputError
        No such file, a column that is missing, a value that is not a whole number, or a kind that is not known.
    """
    text = read_text(path)
    try:
        rows = list(csv.DictReader(StringIO(text), strict=True))
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as a table of labels ({error}); correct the file") from None
    missing = [column for column in COLUMNS if not rows or column not in rows[0]]
    if missing:
        raise InputError(
            f"{path}: has no column {missing[0]!r}; a table of labels has the columns {', '.join(COLUMNS)}"
        )
    names = []
    for number, row in enumerate(rows, start=2):
        kind = (row["kind"] or "").strip()
        if kind not in list(TissueKind):
            raise InputError(f"{path}: line {number}: kind is {kind!r}; known are {', '.join(TissueKind)}")
        try:
            value = int(row["value"])
        except (TypeError, ValueError):
            raise InputError(f"{path}: line {number}: value is {row['value']!r}; expected a whole number") from None
        names.append(LabelName(value, (row["name"] or "").strip(), TissueKind(kind)))
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
