"""Text files -> their text, and lengths -> lengths that can be: what every reader of text and positions asks first."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Points
from musclefit.vocabulary import Unit

LARGEST_MM = 1e9
"""A coordinate beyond this, mm, cannot belong to a body: a thousand kilometres; its squares would still be finite."""


def read_text(path: Path, *, error: type[InputError] = InputError) -> str:
    """The text of a file in UTF-8, with or without a byte order mark.

    Raises
    ------
    InputError
        The file cannot be read.
    error
        It is no UTF-8.
    """
    return decoded(read_bytes(path), str(path), error=error)


def read_bytes(path: Path) -> bytes:
    """The bytes of a file; InputError where they cannot be read."""
    try:
        return path.read_bytes()
    except OSError as problem:
        raise InputError(
            f"{path}: cannot be read ({problem.strerror}); correct the path or its permissions"
        ) from problem


def decoded(data: bytes, source: str, *, error: type[InputError] = InputError) -> str:
    """The text that bytes in UTF-8 hold; ``error`` names the first byte that is not a character."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise error(f"{source}: is not UTF-8 text (byte {problem.start} is not valid); save it as UTF-8") from None


def in_mm(positions: Points, units: Unit, *, source: str, error: type[InputError] = InputError) -> Points:
    """Positions of a file in mm; ``error`` where one is finite and so large that it cannot be a place of a body.

    Parameters
    ----------
    positions : (..., 3) float64, in ``units``
    units : Unit
    source : str
        The file, for messages.
    error : type of InputError
    """
    with np.errstate(over="ignore"):
        scaled: Points = positions * units.in_mm
    large = np.isfinite(positions) & ~(np.abs(scaled) <= LARGEST_MM)
    if large.any():
        found = positions[large].flat[0]
        raise error(
            f"{source}: has a coordinate of {found:.6g} {units}, which cannot be a place of a body (at most "
            f"{LARGEST_MM / units.in_mm:.0e}); the file is damaged or its units are wrong"
        )
    return scaled
