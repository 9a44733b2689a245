"""Files of landmarks and of where they go: in one table, or in two that are matched by name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from musclefit.errors import InputError, LandmarkError
from musclefit.geometry.arrays import Points
from musclefit.io.formats.landmarks import LandmarkTable, paired, positions_of, read_landmarks
from musclefit.rig.drive import Files
from musclefit.rig.keyframes import PlaceKey
from musclefit.vocabulary import Unit

PREFIXES = ("", "target_")
"""What columns of positions and of targets start with."""


def read_pairs(
    source: str, target: str, files: Files, *, units: Unit, prefixes: tuple[str, str] = PREFIXES
) -> tuple[LandmarkTable, Points]:
    """The landmarks and where they go, (m, 3) mm.

    Raises
    ------
    RigError, LandmarkError
        Files that are missing or cannot be used, names without a partner, or no targets.
    """
    table = _landmarks(source, files, key="drive.source", units=units, prefixes=prefixes)
    if target:
        other = _landmarks(target, files, key="drive.target", units=units, prefixes=prefixes)
        try:
            table = paired(table, other)
        except InputError as error:
            raise files.named("drive.target", error) from None
    if table.targets is None:
        raise LandmarkError(
            f"{files.rig}: drive.source: {source} has no target columns ({prefixes[1]}x_mm, ...); add "
            "them, say how they start in drive.target_prefix, or name a second file in drive.target"
        )
    return table, table.targets


def read_keyframes(
    keyframes: Sequence[PlaceKey],
    files: Files,
    *,
    names: Sequence[str],
    units: Unit,
    prefixes: tuple[str, str] = PREFIXES,
) -> tuple[tuple[float, Points], ...]:
    """Moments and (m, 3) places, in the order of the names, mm."""
    found = []
    for key in keyframes:
        table = _landmarks(key.file, files, key="drive.keyframes", units=units, prefixes=prefixes)
        try:
            found.append((key.at, positions_of(table, names)))
        except LandmarkError as error:
            raise files.named("drive.keyframes", error) from None
    return tuple(found)


def _landmarks(path: str, files: Files, *, key: str, units: Unit, prefixes: tuple[str, str]) -> LandmarkTable:
    files.read(Path(path), key=key)
    try:
        return read_landmarks(Path(path), units=units, source_prefix=prefixes[0], target_prefix=prefixes[1])
    except InputError as error:
        raise files.named(key, error) from None
