"""A finished sequence, read back from its folder without its rig: report, frames, and surfaces at rest and in poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.io.formats.tables import parse_json
from musclefit.io.formats.texts import read_bytes
from musclefit.io.formats.vtk_xml import VtkFile
from musclefit.io.run_folder import REPORT_JSON
from musclefit.io.sequence_frames import PLAN, RECORD, REST, SURFACES, StoredFrame, read_frame
from musclefit.report.reading import wrong_in_frame, wrong_in_sequence_report
from musclefit.report.sequence import MADE, SEQUENCE_SCHEMA_VERSION, FrameSummary

_KEYS = ("title", "verdict", "resampling", "limits", "checks", "frames", "provenance")
"""What every report of a sequence has."""

_AGAIN = "make the sequence again in the same folder with this version of musclefit, which keeps its frames"


@dataclass(frozen=True, eq=False, slots=True)
class FinishedFrame:
    """A frame that was read back.

    Parameters
    ----------
    stored : StoredFrame
        Verified by hash.
    result : mapping or None
        What was measured, as the report of a run holds it; None where the frame was not made.
    """

    stored: StoredFrame
    result: Mapping[str, Any] | None

    @property
    def summary(self) -> FrameSummary:
        """Pose, checks and measures."""
        return self.stored.summary

    @property
    def made(self) -> bool:
        """Whether it has an anatomy."""
        return self.summary.outcome == MADE


@dataclass(frozen=True, eq=False, slots=True)
class FinishedSequence:
    """A sequence that was written.

    Parameters
    ----------
    folder : Path
    report : mapping
        As report.json holds it.
    rest : Anatomy
        The given triangles at rest.
    frames : tuple of FinishedFrame
        In order of time.
    """

    folder: Path
    report: Mapping[str, Any]
    rest: Anatomy
    frames: tuple[FinishedFrame, ...]

    @property
    def title(self) -> str:
        """The title of the sequence."""
        return str(self.report["title"])

    @property
    def made(self) -> tuple[FinishedFrame, ...]:
        """The frames that have an anatomy."""
        return tuple(frame for frame in self.frames if frame.made)

    def anatomy(self, frame: FinishedFrame) -> Anatomy:
        """The given triangles in a frame that was made, mm, double precision."""
        return self.rest.with_vertices(frame.stored.vertices())

    def surfaces(self, frame: FinishedFrame) -> tuple[Anatomy, Anatomy]:
        """The triangles of a frame that were measured, at rest and in its pose, mm, single precision.

        Raises
        ------
        InputError, MeshError
            The file is not as a sequence writes it.
        """
        path = frame.stored.folder / SURFACES
        file = VtkFile(read_bytes(path), str(path), kind="PolyData")
        moved = file.point_data("displacement_mm", components=3)
        owners = file.cell_data("tissue", count="NumberOfPolys")
        if moved is None or owners is None:
            raise InputError(f"{path} is not as a sequence writes it; {_AGAIN}")
        posed, triangles = file.points(), _triangles(file, path)
        rest, shown = [], []
        start = 0
        for number, tissue in enumerate(self.rest):
            faces = triangles[owners == number]
            stop = int(faces.max(initial=start - 1)) + 1
            own = faces - start
            if own.min(initial=0) < 0:
                raise InputError(f"{path} is not as a sequence writes it; {_AGAIN}")
            place = posed[start:stop]
            shown.append(Tissue(tissue.name, tissue.kind, TriMesh(place, own)))
            rest.append(Tissue(tissue.name, tissue.kind, TriMesh(place - moved[start:stop], own)))
            start = stop
        return Anatomy(tuple(rest), self.rest.frame), Anatomy(tuple(shown), self.rest.frame)


def is_sequence(folder: str | Path) -> bool:
    """Whether a folder holds what musclefit sequence wrote."""
    return (Path(folder) / PLAN).is_file()


def read_finished_sequence(folder: str | Path) -> FinishedSequence:
    """Read a sequence back.

    Parameters
    ----------
    folder : path
        That `musclefit sequence` wrote.

    Raises
    ------
    InputError, MeshError
        The folder holds no sequence, or not the whole of one, or that of another version.
    """
    place = Path(folder)
    report_path, plan_path = place / REPORT_JSON, place / PLAN
    for path in (plan_path, report_path):
        if not path.is_file():
            raise InputError(f"{place} holds no {path.name} of a sequence that came to its end; {_AGAIN}")
    report = parse_json(read_bytes(report_path), source=str(report_path))
    plan = parse_json(read_bytes(plan_path), source=str(plan_path))
    if not isinstance(report, dict) or any(key not in report for key in _KEYS) or not isinstance(plan, dict):
        raise InputError(f"{report_path} is not the report of a sequence; name a folder that musclefit sequence wrote")
    if report.get("schema_version") != SEQUENCE_SCHEMA_VERSION:
        raise InputError(
            f"{report_path}: found schema version {report.get('schema_version')!r}; expected "
            f"{SEQUENCE_SCHEMA_VERSION}: {_AGAIN}"
        )
    problem = wrong_in_sequence_report(report)
    if problem:
        raise InputError(f"{report_path} is not as a sequence writes it ({problem}); {_AGAIN}")
    if not isinstance(plan.get("tissues"), list) or not (place / REST).is_file():
        raise InputError(f"{place} holds no anatomy at rest ({REST}); {_AGAIN}")
    frame = str(report["provenance"]["settings"]["anatomy"]["frame"])
    return FinishedSequence(place, report, _rest(place / REST, plan["tissues"], frame), _frames(place, plan))


def _frames(folder: Path, plan: Mapping[str, Any]) -> tuple[FinishedFrame, ...]:
    count = plan.get("frames")
    if not isinstance(count, int) or count < 0:
        raise InputError(f"{folder / PLAN}: found {count!r:.60} frames; expected a whole number; {_AGAIN}")
    found = []
    for number in range(count):
        stored = read_frame(folder, number, key="")
        if isinstance(stored, str):
            raise InputError(f"{folder}: frame {number}: {stored}; {_AGAIN}")
        record = parse_json(read_bytes(stored.folder / RECORD), source=str(stored.folder / RECORD))
        problem = wrong_in_frame(record["result"], stored.summary)
        if problem:
            raise InputError(f"{stored.folder / RECORD} is not as a sequence writes it ({problem}); {_AGAIN}")
        found.append(FinishedFrame(stored, record["result"]))
    return tuple(found)


def _rest(path: Path, told: list[Any], frame: str) -> Anatomy:
    """The anatomy at rest from its file, cut into tissues."""
    file = VtkFile(read_bytes(path), str(path), kind="PolyData")
    points, faces = file.points(), _triangles(file, path)
    try:
        listed = [
            (str(one["name"]), TissueKind(one["kind"]), int(one["vertices"]), int(one["triangles"])) for one in told
        ]
    except (TypeError, KeyError, ValueError, OverflowError):
        raise InputError(
            f"{path.with_name(PLAN)} lists tissues otherwise than a sequence writes them; {_AGAIN}"
        ) from None
    counts = [(vertices, triangles) for _, _, vertices, triangles in listed]
    if min(map(min, counts), default=0) < 0:
        raise InputError(f"{path.with_name(PLAN)} lists tissues of negative size; {_AGAIN}")
    if (sum(v for v, _ in counts), sum(f for _, f in counts)) != (len(points), len(faces)):
        raise InputError(f"{path} and {PLAN} tell of different tissues; {_AGAIN}")
    tissues, v, f = [], 0, 0
    for name, kind, vertices, triangles in listed:
        own = faces[f : f + triangles] - v
        tissues.append(Tissue(name, kind, TriMesh(_part(points, v, vertices), own)))
        v, f = v + vertices, f + triangles
    return Anatomy(tuple(tissues), frame)


def _part(points: Points, start: int, count: int) -> Points:
    return np.ascontiguousarray(points[start : start + count])


def _triangles(file: VtkFile, path: Path) -> Int:
    polys = file.cells("Polys", count="NumberOfPolys")
    if (polys.sizes != 3).any():
        raise MeshError(f"{path} holds cells that are not triangles; {_AGAIN}")
    return polys.corners.reshape(-1, 3)
