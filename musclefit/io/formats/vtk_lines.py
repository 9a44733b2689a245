"""Polylines as VTK's legacy files, which ParaView opens; knows no muscle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from musclefit.geometry.arrays import Float, Points


def vtk_lines(lines: Sequence[Points], *, title: str, line_data: Mapping[str, Float]) -> bytes:
    """Polylines with numbers for each line, binary, of doubles.

    Parameters
    ----------
    lines : sequence of (p, 3) float64, mm
    title : str
    line_data : mapping of name to (lines,)
    """
    points = np.concatenate(lines) if lines else np.zeros((0, 3))
    ends = np.cumsum([0, *(len(line) for line in lines)])
    said = " ".join(title.encode("ascii", "backslashreplace").decode("ascii").split())[:200]
    counts = np.diff(ends)
    starts = np.cumsum([0, *(counts + 1)])[:-1]
    cells = np.empty(len(points) + len(lines), dtype=">i4")
    cells[np.setdiff1d(np.arange(len(cells)), starts)] = np.arange(len(points))
    cells[starts] = counts
    parts = [
        f"# vtk DataFile Version 3.0\n{said}\nBINARY\nDATASET POLYDATA\nPOINTS {len(points)} double\n".encode("ascii"),
        _big_endian(points),
        f"LINES {len(lines)} {len(cells)}\n".encode("ascii"),
        cells.tobytes() + b"\n",
    ]
    if line_data:
        parts.append(f"CELL_DATA {len(lines)}\n".encode("ascii"))
    for name, values in line_data.items():
        parts += [f"SCALARS {name} double 1\nLOOKUP_TABLE default\n".encode("ascii"), _big_endian(values)]
    return b"".join(parts)


def _big_endian(values: Float) -> bytes:
    return np.ascontiguousarray(values, dtype=">f8").tobytes() + b"\n"
