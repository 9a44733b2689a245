"""Which patient frame coordinates are in: what is stated at several places must agree, or is converted."""

from __future__ import annotations

from dataclasses import replace

from musclefit.anatomy.findings import Finding
from musclefit.errors import InputError
from musclefit.geometry.images import grids
from musclefit.geometry.images.grids import Frame, stated_frame
from musclefit.io.formats.landmarks import LandmarkTable
from musclefit.workflows.given import word


def frame_of(stated: str, given: Frame | str | None) -> Frame:
    """The frame of a rig's coordinates.

    Parameters
    ----------
    stated : str
        The rig's ``anatomy.frame``.
    given : Frame, str or None
        What is said beside it; None to take the rig's word.

    Raises
    ------
    InputError
        Neither says it, or they differ.
    """
    named = stated_frame(stated)
    if given is None:
        if named is None:
            raise InputError(
                f'the rig\'s anatomy.frame is "{stated}", which names not one of LPS and RAS; state it there, or give '
                "--frame (surfaces from 3D Slicer are LPS, MNI space is RAS)"
            )
        return named
    frame = word(Frame, given, what="frame")
    if named is not None and frame is not named:
        raise InputError(f'the rig\'s anatomy.frame is "{stated}", but --frame is {frame.value}; correct one of them')
    return frame


def in_frame(table: LandmarkTable, frame: str, *, of: str) -> tuple[LandmarkTable, tuple[Finding, ...]]:
    """Landmarks in the frame of what they lie on, from LPS to RAS or back where both are stated.

    Parameters
    ----------
    table : LandmarkTable
    frame : str
        Stated for what they lie on, as `stated_frame` reads it.
    of : str
        What that is, for the finding where the table alone states a frame.
    """
    stated, there = stated_frame(table.coordinate_system), stated_frame(frame)
    if stated is None:
        return table, table.findings
    if there is None:
        said = f"{table.path}: states {stated.name}, and the {of}'s frame is not stated (--frame); taken as they stand"
        return table, (*table.findings, Finding(table.path.name, "unstated-frame", said))
    positions = grids.in_frame(table.positions, of=stated, to=there)
    return replace(table, positions=positions, coordinate_system=there.name), table.findings
