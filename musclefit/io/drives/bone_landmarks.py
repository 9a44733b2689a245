"""Landmarks on bones, which joints and transforms take along: from a file, or spread over each bone."""

from __future__ import annotations

from pathlib import Path

from musclefit.errors import InputError, LandmarkError
from musclefit.io.formats.landmarks import LandmarkTable, read_landmarks
from musclefit.rig.drive import Files
from musclefit.rig.handles import Handles
from musclefit.rig.table_reader import Section
from musclefit.vocabulary import Unit


def refuse_two_ways(section: Section) -> None:
    """Raise RigError where landmarks are given and asked to be spread."""
    if "landmarks" in section and "landmarks_per_bone" in section:
        raise section.error("landmarks_per_bone", "has no effect beside drive.landmarks; remove one of the two")


def read_bone_landmarks(path: str, files: Files, *, units: Unit, movers: str) -> LandmarkTable:
    """The landmarks of a file without targets; ``movers`` say where they go, for messages.

    Raises
    ------
    RigError, LandmarkError
        A file that is missing, cannot be used, or has targets.
    """
    files.read(Path(path), key="drive.landmarks")
    try:
        table = read_landmarks(Path(path), units=units)
    except InputError as error:
        raise files.named("drive.landmarks", error) from None
    if table.targets is not None:
        raise LandmarkError(
            f"{files.rig}: drive.landmarks: {path} has target columns, but {movers} say where landmarks "
            'go; remove the columns, or use a drive of kind "landmarks"'
        )
    return table


def handles_of(table: LandmarkTable) -> Handles:
    """The landmarks as handles."""
    return Handles(table.names, table.positions, table.bones)
