"""The frames of a finished sequence, read back from its folder."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError
from musclefit.io.sequence_frames import PLAN, StoredFrame, read_frame
from musclefit.report.sequence import MADE, FrameSummary
from musclefit.rig.job import Job


@dataclass(frozen=True, eq=False, slots=True)
class FrameOnDisk:
    """A frame of a sequence that was read back: its summary, and its anatomy when asked for."""

    stored: StoredFrame
    rest: Anatomy

    @property
    def summary(self) -> FrameSummary:
        """Pose, checks and measures."""
        return self.stored.summary

    def anatomy(self) -> Anatomy:
        """The given triangles in the pose, double precision.

        Raises
        ------
        InputError
            The frame was refused or failed.
        """
        if self.summary.outcome != MADE:
            raise InputError(f"frame {self.summary.number} has no anatomy: {self.summary.problem}")
        return self.rest.with_vertices(self.stored.vertices())


def read_frames(job: Job, folder: str | Path) -> Iterator[FrameOnDisk]:
    """The frames of a sequence on disk, in order of time.

    Parameters
    ----------
    job : Job
        The rig that made it.
    folder : path

    Returns
    -------
    iterator of FrameOnDisk

    Raises
    ------
    InputError
        The folder holds no sequence, a frame is missing or was changed, or it was made of another rig.
    """
    folder = Path(folder)
    plan = read_plan(folder)
    if plan["inputs"] != dict(job.hashes):
        raise InputError(f"{folder} was made of other files than {job.source} names now; run the sequence again")
    for number in range(plan["frames"]):
        stored = read_frame(folder, number, key="")
        if isinstance(stored, str):
            raise InputError(f"{folder}: frame {number}: {stored}; run the sequence again, it keeps the others")
        yield FrameOnDisk(stored, job.anatomy)


def read_plan(folder: Path) -> dict[str, Any]:
    """What the folder's sequence was made of.

    Raises
    ------
    InputError
        The folder holds no sequence.
    """
    try:
        plan = json.loads((folder / PLAN).read_text(encoding="utf-8"))
        if {"frames", "interpolation", "inputs"} <= plan.keys():
            return plan  # type: ignore[no-any-return]
    except (OSError, ValueError, AttributeError):
        pass
    raise InputError(f"{folder} holds no {PLAN} of a sequence; name a new folder, or that of a sequence")
