"""Which patient frame a rig is in: what it states and what is said beside it must agree."""

from __future__ import annotations

from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame, stated_frame
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
