"""Displacements of a lattice's control points <- CSV; knows columns and lines, not what a lattice does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from musclefit.errors import LandmarkError
from musclefit.geometry.arrays import Points
from musclefit.io.formats.rows import Rows, csv_lines
from musclefit.io.formats.texts import in_mm, read_text
from musclefit.vocabulary import Unit

INDICES = ("i", "j", "k")
"""Columns that number a control point along x, y and z, from 0."""


def read_displacements(path: Path, *, shape: tuple[int, int, int], units: Unit) -> Points:
    """(K, 3) displacements of a lattice's control points, mm; those that the file leaves out stay where they are.

    Parameters
    ----------
    path : Path
        CSV with the columns ``i``, ``j``, ``k`` (from 0, along x, y and z) and ``dx``, ``dy``, ``dz`` in ``units``, or
        ``dx_mm``, ``dy_mm``, ``dz_mm``.
    shape : three int
    units : Unit

    Raises
    ------
    LandmarkError
        Columns that are missing, values that are not numbers, a control point that the lattice does not have, or that
        is moved twice; the message names the line.
    """
    text = read_text(path, error=LandmarkError)
    lines = csv_lines(text, path, delimiter=max(",;\t", key=(text.lstrip().splitlines() or [""])[0].count))
    if len(lines) < 2:
        raise LandmarkError(f"{path}: moves no control point; give a heading and a line for each that moves")
    table = Rows(path, tuple(cell.strip().lower() for cell in lines[0][1]), tuple(lines[1:]))
    table.check_widths()
    stated = "dx_mm" in table.headings
    found = table.numbers([*INDICES, *(f"{axis}_mm" if stated else axis for axis in ("dx", "dy", "dz"))])
    out, seen = np.zeros((*shape, 3)), np.zeros(shape, dtype=bool)
    for (line, _), row in zip(table.rows, found, strict=True):
        index = tuple(int(x) for x in row[:3])
        if any(x != k for x, k in zip(row[:3], index, strict=True)) or not all(
            0 <= k < count for k, count in zip(index, shape, strict=True)
        ):
            raise LandmarkError(
                f"{path}: line {line} moves control point {row[:3].tolist()}; the lattice has whole numbers from 0 to "
                f"{[count - 1 for count in shape]}"
            )
        if seen[index]:
            raise LandmarkError(f"{path}: line {line} moves control point {list(index)} again; remove one of the lines")
        seen[index], out[index] = True, row[3:]
    unit = Unit.MILLIMETRE if stated else units
    return in_mm(out.reshape(-1, 3), unit, source=str(path), error=LandmarkError)
