"""Polylines as VTK's legacy files, which ParaView opens; knows no muscle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from musclefit.geometry.arrays import Float, Points


def vtk_lines(lines: Sequence[Points], *, title: str, line_data: Mapping[str, Float]) -> bytes:
    """Polylines with numbers for each line, as text of doubles.

    Parameters
    ----------
    lines : sequence of (p, 3) float64, mm
    title : str
    line_data : mapping of name to (lines,)
    """
    points = np.concatenate(lines) if lines else np.zeros((0, 3))
    ends = np.cumsum([0, *(len(line) for line in lines)])
    said = " ".join(title.encode("ascii", "backslashreplace").decode("ascii").split())[:200]
    parts = [
        f"# vtk DataFile Version 3.0\n{said}\nASCII\nDATASET POLYDATA",
        f"POINTS {len(points)} double",
        _rows(points),
    ]
    parts.append(f"LINES {len(lines)} {len(lines) + len(points)}")
    parts += [" ".join(map(str, [b - a, *range(a, b)])) for a, b in pairwise(ends)]
    if line_data:
        parts.append(f"CELL_DATA {len(lines)}")
    for name, values in line_data.items():
        parts += [f"SCALARS {name} double 1\nLOOKUP_TABLE default", _rows(values)]
    return ("\n".join(parts) + "\n").encode("ascii")


def _rows(values: Float) -> str:
    return "\n".join(" ".join(repr(float(x)) for x in np.atleast_1d(row)) for row in values)
