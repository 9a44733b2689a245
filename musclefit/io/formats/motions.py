"""Keyframe files: takes a CSV of joint angles over time, gives a `Motion`."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from musclefit.errors import InputError
from musclefit.io.formats.rows import csv_lines
from musclefit.io.formats.texts import decoded
from musclefit.rig.motion import Motion

TIME = "time_s"
ANGLE = "_deg"
REMARKS = ("phase", "remark")
"""Columns of words for the reader."""


def read_motion(path: str | Path) -> Motion:
    """Read keyframes.

    Parameters
    ----------
    path : path of a CSV file
        A line of headings, then one keyframe per line: ``time_s`` in seconds, rising; ``<coordinate>_deg`` in degrees
        for each coordinate of the joints that moves; ``phase`` and ``remark`` are words for the reader.

    Returns
    -------
    Motion

    Raises
    ------
    InputError
        The file cannot be read, another column, a value that is not a finite number, or what `Motion` refuses; the
        message names file, line and column.
    """
    path = Path(path)
    if path.suffix.lower() in (".mot", ".sto"):
        raise InputError(
            f'{path}: a motion of OpenSim is read with its model, by a rig of drive.kind = "opensim"; make one of the '
            "model with `musclefit import-osim`, or give a CSV with time_s and <coordinate>_deg"
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: the motion cannot be read: {error.strerror or error}") from None
    text = decoded(data, str(path))
    lines = csv_lines(text, path, delimiter=",") if text.strip() else []
    if not lines:
        raise InputError(f"{path}: is empty; expected the columns {TIME} and <coordinate>{ANGLE}")
    headings = tuple(cell.strip() for cell in lines[0][1])
    coordinates = _coordinates(headings, path)
    wanted = [TIME, *(f"{name}{ANGLE}" for name in coordinates)]
    values = np.empty((len(lines) - 1, len(wanted)))
    for row, (line, cells) in enumerate(lines[1:]):
        if len(cells) != len(headings):
            raise InputError(f"{path}: line {line} has {len(cells)} values for {len(headings)} columns; correct it")
        for column, heading in enumerate(wanted):
            values[row, column] = _number(cells[headings.index(heading)], path, line, heading)
    return Motion(values[:, 0], coordinates, values[:, 1:], str(path))


def _coordinates(headings: tuple[str, ...], path: Path) -> tuple[str, ...]:
    doubled = [heading for heading in headings if headings.count(heading) > 1]
    if doubled:
        raise InputError(f"{path}: two columns are named {doubled[0]!r}; remove one")
    if TIME not in headings:
        raise InputError(f"{path}: no column {TIME}; found are: {', '.join(headings)}")
    for heading in headings:
        if heading not in (TIME, *REMARKS) and (not heading.endswith(ANGLE) or heading == ANGLE):
            raise InputError(
                f"{path}: column {heading!r} is unknown; known are {TIME}, <coordinate>{ANGLE} and for words "
                f"{', '.join(REMARKS)}"
            )
    return tuple(heading.removesuffix(ANGLE) for heading in headings if heading.endswith(ANGLE))


def _number(cell: str, path: Path, line: int, heading: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: line {line}: {heading} is {cell.strip()!r}, no finite number; correct it")
    return value
