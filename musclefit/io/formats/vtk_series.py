"""A motion for ParaView: all tissues of a frame in one file, and the collection that puts the frames on a time line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from musclefit.anatomy.model import Anatomy, TissueKind


def posed_surfaces(rest: Anatomy, posed: Anatomy, *, time_s: float, double: bool = False) -> Any:
    """All surfaces of a frame as one PolyData.

    Points are in single precision, or ``double``, and carry ``displacement_mm``; cells carry ``tissue`` (an index) and
    ``kind`` (0 skin, 1 other, 2 muscle, 3 bone); field data hold the time and, for each tissue,
    ``tissue_<index>_<name>``.
    """
    import pyvista as pv

    where = posed.slices()
    faces = np.concatenate([t.surface.faces + where[t.name].start for t in posed])
    counts = [len(t.surface.faces) for t in posed]
    order = list(TissueKind)
    vertices = posed.vertices()
    surface = pv.PolyData.from_regular_faces(vertices if double else vertices.astype(np.float32), faces)
    surface.point_data["displacement_mm"] = (vertices - rest.vertices()).astype(np.float32)
    surface.cell_data["tissue"] = np.repeat(np.arange(len(counts), dtype=np.int16), counts)
    surface.cell_data["kind"] = np.repeat(np.array([order.index(t.kind) for t in posed], dtype=np.int8), counts)
    surface.field_data["TimeValue"] = np.array([time_s])
    for number, tissue in enumerate(posed):
        name = tissue.name.encode("unicode_escape").decode("ascii")
        surface.field_data[f"tissue_{number}_{name}"] = np.array([number])
    return surface


def collection(frames: Sequence[tuple[float, PurePath]]) -> str:
    """The ``.pvd`` text that puts files on a time line, s; their paths are from the collection's folder."""
    lines = [
        f'    <DataSet timestep="{time!r}" group="" part="0" file={quoteattr(path.as_posix())}/>'
        for time, path in frames
    ]
    return "\n".join(
        [
            '<?xml version="1.0"?>',
            '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">',
            "  <Collection>",
            *lines,
            "  </Collection>",
            "</VTKFile>",
            "",
        ]
    )
