"""A sequence's motion, from its folder to one file for ParaView."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from musclefit.errors import InputError
from musclefit.io.atomic import check_file_writable, partial_file
from musclefit.io.finished_sequences import read_finished_sequence
from musclefit.io.formats.vtkhdf import write_vtkhdf
from musclefit.progress import Progress
from musclefit.workflows.progress import watched

VTKHDF = ".vtkhdf"


@dataclass(frozen=True, slots=True)
class MotionWritten:
    """A motion that was written.

    Parameters
    ----------
    path : Path
    steps : int
        Frames in it.
    not_made : tuple of float
        Times of frames that the sequence could not make, s; they are not in it.
    tissues, points : int
    """

    path: Path
    steps: int
    not_made: tuple[float, ...]
    tissues: int
    points: int

    def to_json(self) -> dict[str, Any]:
        """All of it."""
        return {
            "file": str(self.path),
            "steps": self.steps,
            "not_made_s": list(self.not_made),
            "tissues": self.tissues,
            "points": self.points,
        }


def export_motion(sequence: str | Path, out: str | Path, *, progress: Progress | None = None) -> MotionWritten:
    """Write all frames of a sequence into one VTKHDF file: the given triangles once, their points at each time.

    Parameters
    ----------
    sequence : path
        The folder that `sequence` wrote.
    out : path
        The .vtkhdf file; replaced.
    progress : Progress, optional

    Returns
    -------
    MotionWritten
        The file, its number of frames, and the times of frames that the sequence could not make.

    Raises
    ------
    InputError, MeshError
        No sequence, or not the whole of one; no frame was made; a file of another ending; or h5py is not installed.
    """
    path = Path(out)
    if path.suffix.lower() != VTKHDF:
        raise InputError(f"{path}: the ending {path.suffix!r} is no known format of motions; use {VTKHDF}")
    check_file_writable(path)
    found = read_finished_sequence(sequence)
    if not found.made:
        raise InputError(f"{sequence}: no frame of this sequence was made, so that there is no motion to write")
    path.parent.mkdir(parents=True, exist_ok=True)
    with partial_file(path) as partial, watched(progress) as stages, stages.stage("motion") as tick:

        def steps() -> Any:
            for number, frame in enumerate(found.made, start=1):
                yield frame.summary.time_s, frame.stored.vertices()
                tick(number / len(found.made))

        written = write_vtkhdf(partial, found.rest, steps())
    not_made = tuple(frame.summary.time_s for frame in found.frames if not frame.made)
    return MotionWritten(path, written, not_made, len(tuple(found.rest)), len(found.rest.vertices()))
