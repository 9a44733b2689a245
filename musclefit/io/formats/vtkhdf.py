"""A motion as one VTKHDF file, which ParaView opens: triangles once, points step by step; knows no rig.

Format: VTKHDF 2.0, type PolyData with steps (VTK's file formats, "VTKHDF File Format"). VTK's own writer repeats the
triangles in every step.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import InputError
from musclefit.geometry.arrays import Points

_CELLS = ("Vertices", "Lines", "Strips", "Polygons")


def write_vtkhdf(path: Path, rest: Anatomy, steps: Iterable[tuple[float, Points]]) -> int:
    """Write surfaces that move; how many steps were written.

    Points and ``displacement_mm`` are in single precision; cells carry ``tissue`` (an index) and ``kind`` (0 skin, 1
    other, 2 muscle, 3 bone), field data the ``tissue_names``.

    Parameters
    ----------
    path : Path
        Written from its beginning; the caller puts it in place.
    rest : Anatomy
    steps : iterable of (time, (n, 3) float64)
        Time in s; vertices of all tissues in the order of ``Anatomy.vertices``, mm.

    Raises
    ------
    InputError
        h5py is not installed.
    """
    h5py = _h5py()
    where, vertices = rest.slices(), rest.vertices()
    faces = np.concatenate([t.surface.faces + where[t.name].start for t in rest])
    counts = [len(t.surface.faces) for t in rest]
    kinds = list(TissueKind)
    size, times = len(vertices), []
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array([2, 0])
        root.attrs.create("Type", b"PolyData", dtype=h5py.string_dtype("ascii", len(b"PolyData")))
        root["NumberOfPoints"] = np.array([size])
        for name in _CELLS:
            triangles = faces if name == "Polygons" else faces[:0]
            group = root.create_group(name)
            group["NumberOfCells"], group["NumberOfConnectivityIds"] = [len(triangles)], [triangles.size]
            group["Offsets"] = np.arange(len(triangles) + 1) * 3
            group.create_dataset("Connectivity", data=triangles.ravel(), compression="gzip" if len(triangles) else None)
        own = np.repeat(np.arange(len(counts), dtype=np.int16), counts)
        root["CellData/tissue"] = own
        root["CellData/kind"] = np.array([kinds.index(t.kind) for t in rest], dtype=np.int8)[own]
        names = [t.name.encode("unicode_escape") for t in rest]
        root.create_dataset("FieldData/tissue_names", data=names, dtype=h5py.string_dtype("ascii"))
        points = _growing(root, "Points", size)
        moved = _growing(root, "PointData/displacement_mm", size)
        for number, (time_s, places) in enumerate(steps):
            for data, values in ((points, places), (moved, places - vertices)):
                data.resize((number + 1) * size, axis=0)
                data[number * size :] = values
            times.append(time_s)
        _write_steps(root, times, size, tissues=len(counts))
    return len(times)


def _write_steps(root: Any, times: list[float], size: int, *, tissues: int) -> None:
    """Which part of each array belongs to which step: of points one after the other, of cells the same for all."""
    steps, count = root.create_group("Steps"), len(times)
    steps.attrs["NSteps"] = count
    steps["Values"] = np.array(times)
    steps["PartOffsets"], steps["NumberOfParts"] = np.zeros(count, dtype=int), np.ones(count, dtype=int)
    steps["PointOffsets"] = size * np.arange(count)
    steps["CellOffsets"] = steps["ConnectivityIdOffsets"] = np.zeros((count, len(_CELLS)), dtype=int)
    steps["PointDataOffsets/displacement_mm"] = size * np.arange(count)
    for name in ("tissue", "kind"):
        steps[f"CellDataOffsets/{name}"] = np.zeros(count, dtype=int)
    steps["FieldDataOffsets/tissue_names"] = np.zeros(count, dtype=int)
    steps["FieldDataSizes/tissue_names"] = np.tile([1, tissues], (count, 1))


def _growing(root: Any, name: str, size: int) -> Any:
    return root.create_dataset(
        name,
        shape=(0, 3),
        maxshape=(None, 3),
        chunks=(min(size, 1 << 16), 3),
        dtype="f4",
        compression="gzip",
        shuffle=True,
    )


def _h5py() -> Any:
    try:
        import h5py  # type: ignore[import-untyped]
    except ImportError:
        raise InputError("a .vtkhdf file needs h5py, which is not installed; pip install 'musclefit[motion]'") from None
    return h5py
