"""The frames of a sequence on disk: each in a folder of its own, whole or not at all, verified by hash when read."""

from __future__ import annotations

import json
import math
import shutil
import uuid
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from musclefit._version import __version__
from musclefit.anatomy.model import Anatomy
from musclefit.geometry.arrays import Points
from musclefit.io.atomic import partial_file
from musclefit.io.formats.vtk_series import posed_surfaces
from musclefit.io.run_folder import save_whole
from musclefit.pipeline.retarget import settings_of
from musclefit.pipeline.sequence import Frame, at_rest, posed_job
from musclefit.report.schema import side_to_json
from musclefit.report.sequence import FrameSummary, summary_of
from musclefit.rig.job import Job
from musclefit.rig.motion import Pose

PLAN, REST = "sequence.json", "rest.vtp"
FRAMES, VERTICES, SURFACES, RECORD = "frames", "vertices.npy", "tissues.vtp", "frame.json"


@dataclass(frozen=True, slots=True)
class StoredFrame:
    """A frame that was read back whole: its summary, its folder and the hash of its vertices ("" without anatomy)."""

    summary: FrameSummary
    folder: Path
    vertices_sha256: str

    def vertices(self) -> Points:
        """(N, 3) vertices of all tissues in the order of ``Anatomy.vertices``, mm."""
        return np.load(self.folder / VERTICES, allow_pickle=False)  # type: ignore[no-any-return]


def frame_key(job: Job, pose: Pose) -> str:
    """What a frame depends on, as a hash: every setting, every input file, the pose, the version; no other frame."""
    posed = posed_job(job, pose)
    told = {
        "version": __version__,
        "settings": settings_of(posed),
        "inputs": dict(job.hashes),
        "time_s": pose.time_s,
    }
    return sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()


def frame_folder(sequence: Path, number: int) -> Path:
    """Where a frame of a sequence is."""
    return sequence / FRAMES / f"{number:04d}"


def tissues_in_order(anatomy: Anatomy) -> list[dict[str, Any]]:
    """What the rows of ``vertices.npy`` and the triangles of ``rest.vtp`` belong to, one tissue after the other."""
    return [
        {
            "name": tissue.name,
            "kind": tissue.kind.value,
            "vertices": len(tissue.surface.vertices),
            "triangles": len(tissue.surface.faces),
        }
        for tissue in anatomy
    ]


def write_rest(sequence: Path, rest: Anatomy) -> None:
    """Write the given triangles at rest, in double precision, whole or not at all."""
    with partial_file(sequence / REST, ending=".vtp") as partial:
        save_whole(posed_surfaces(rest, rest, time_s=0.0, double=True), partial)


def write_frame(sequence: Path, frame: Frame, *, job: Job, cpu_s: Mapping[str, float]) -> None:
    """Write a frame into a folder beside, then put it in place of a former one.

    ``vertices.npy`` holds the given vertices in double precision, ``tissues.vtp`` all surfaces for ParaView, as fine as
    they were measured, ``frame.json`` what was measured, with the hashes of both and of itself.
    """
    target = frame_folder(sequence, frame.pose.number)
    target.parent.mkdir(parents=True, exist_ok=True)
    build = target.with_name(f".{target.name}.partial-{uuid.uuid4().hex}")
    build.mkdir()
    try:
        if frame.anatomy is not None:
            data = BytesIO()
            np.save(data, np.asarray(frame.anatomy.vertices()), allow_pickle=False)
            (build / VERTICES).write_bytes(data.getvalue())
            rest, posed = frame.surfaces or (job.anatomy, frame.anatomy)
            save_whole(posed_surfaces(rest, posed, time_s=frame.pose.time_s), build / SURFACES)
        record = _record(frame, job=job, cpu_s=cpu_s)
        record["files"] = {path.name: _digest(path.read_bytes()) for path in sorted(build.iterdir())}
        record["sha256"] = _digest(_canonical(record))
        (build / RECORD).write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")
        if target.exists():
            shutil.rmtree(target)
        build.rename(target)
    except BaseException:
        shutil.rmtree(build, ignore_errors=True)
        raise


def read_frame(sequence: Path, number: int, *, key: str) -> StoredFrame | str:
    """The finished frame, or why it must be made (again).

    Parameters
    ----------
    sequence : Path
    number : int
    key : str
        What the frame must have been made of (`frame_key`); "" takes any.
    """
    folder = frame_folder(sequence, number)
    if not folder.is_dir():
        return "not made yet"
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        said = record.pop("sha256")
        if said != _digest(_canonical(record)):
            return f"{RECORD} was changed"
        for name, digest in record["files"].items():
            if _digest((folder / name).read_bytes()) != digest:
                return f"{name} was changed"
        if key and record["key"] != key:
            return "made with other settings, inputs or times"
        return StoredFrame(summary_of(record), folder, record["files"].get(VERTICES, ""))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        return f"{RECORD} cannot be read ({type(error).__name__}: {error})"


def clear_partial(sequence: Path) -> None:
    """Remove what an interrupted run left half-written."""
    for path in (*sequence.glob(".*.partial-*"), *sequence.glob("*/.*.partial-*")):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def rest_distance(anatomy: Anatomy, rest: Anatomy) -> float:
    """Largest distance of a vertex from where it is at rest, mm."""
    return float(np.linalg.norm(anatomy.vertices() - rest.vertices(), axis=1).max())


def _record(frame: Frame, *, job: Job, cpu_s: Mapping[str, float]) -> dict[str, Any]:
    pose = frame.pose
    rests = at_rest(job, pose) and frame.anatomy is not None
    return {
        "key": frame_key(job, pose),
        "number": pose.number,
        "time_s": pose.time_s,
        "pose_deg": dict(pose.degrees),
        "outcome": "made" if frame.anatomy is not None else "refused" if frame.collision is not None else "failed",
        "problem": frame.problem,
        "collision": None if frame.collision is None else asdict(frame.collision),
        "off_rest_mm": rest_distance(frame.anatomy, job.anatomy) if rests and frame.anatomy is not None else None,
        "result": None if frame.side is None else side_to_json(frame.side, job.rig.limits),
        "muscles": [_finite(asdict(muscle)) for muscle in frame.muscles],
        "cpu_s": {name: round(seconds, 3) for name, seconds in cpu_s.items()},
    }


def _finite(record: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in record.items()}


def _canonical(record: Mapping[str, Any]) -> bytes:
    return json.dumps(record, sort_keys=True, allow_nan=False).encode()


def _digest(data: bytes) -> str:
    return sha256(data).hexdigest()
