"""What worker processes of a sequence do: make a frame, or examine what lies between two, and write it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from musclefit.errors import MusclefitError
from musclefit.geometry.arrays import Points
from musclefit.io.atomic import write_atomically
from musclefit.io.sequence_frames import RECORD, VERTICES, frame_folder, write_frame
from musclefit.pipeline.between import between_frames
from musclefit.pipeline.sequence import Stage
from musclefit.progress import Tick
from musclefit.report.sequence import BetweenSummary, PassageSummary
from musclefit.rig.job import Job
from musclefit.rig.motion import Pose

BETWEEN = "between"


@dataclass(frozen=True, eq=False, slots=True)
class _Work:
    stage: Stage
    poses: tuple[Pose, ...]
    folder: Path


_here: list[_Work] = []
"""What this process was prepared for; a worker serves one sequence."""


class _CpuStages:
    """Progress that keeps the CPU seconds of each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        start = time.process_time()
        yield lambda _: None
        self.seconds[name] = self.seconds.get(name, 0.0) + time.process_time() - start


def prepare(job: Job, poses: tuple[Pose, ...], folder: Path) -> None:
    """Prepare this process for a sequence."""
    _here[:] = [_Work(Stage.of(job), poses, folder)]


def make(number: int) -> float:
    """Make and write a frame; the CPU seconds that it took."""
    work, start = _here[0], time.process_time()
    stages = _CpuStages()
    frame = work.stage.frame(work.poses[number], progress=stages)
    cpu_s = {"frame": time.process_time() - start, "march": stages.seconds.get("march", 0.0)}
    write_frame(work.folder, frame, job=work.stage.job, cpu_s=cpu_s)
    return time.process_time() - start


def examine(number: int) -> float:
    """Examine and write what lies between a frame and the next; the CPU seconds that it took."""
    work, start = _here[0], time.process_time()
    rest = work.stage.job.anatomy
    ends = [frame_folder(work.folder, k) / VERTICES for k in (number, number + 1)]
    before, after = (rest.with_vertices(_vertices(path)) for path in ends)
    times = [work.poses[k].time_s for k in (number, number + 1)]
    try:
        found = between_frames(work.stage, (work.poses[number], work.poses[number + 1]), (before, after))
        passages = tuple(
            PassageSummary.of(passage, look, time_s=times[0] + passage.at * (times[1] - times[0]))
            for passage, look in found.meetings
        )
        summary = BetweenSummary(number, number + 1, passages, found.pairs_examined)
    except MusclefitError as error:
        summary = BetweenSummary(number, number + 1, problem=str(error))
    seconds = time.process_time() - start
    write_between(work.folder, replace(summary, cpu_s=round(seconds, 3)), key=between_key(*ends))
    return seconds


def between_key(first: Path, second: Path) -> str:
    """The hash of what two frames hold and were made of: what is looked at closer depends on the rig's settings."""
    made_of = [json.loads(path.with_name(RECORD).read_text(encoding="utf-8"))["key"] for path in (first, second)]
    return sha256(first.read_bytes() + second.read_bytes() + "".join(made_of).encode()).hexdigest()


def write_between(folder: Path, summary: BetweenSummary, *, key: str) -> None:
    """Write what was found between two frames."""
    record = {
        "key": key,
        "first": summary.first,
        "second": summary.second,
        "passages": [asdict(passage) for passage in summary.passages],
        "pairs_examined": summary.pairs_examined,
        "problem": summary.problem,
        "cpu_s": summary.cpu_s,
    }
    write_atomically(folder / BETWEEN / f"{summary.first:04d}.json", json.dumps(record))


_SUMMARY: TypeAdapter[BetweenSummary] = TypeAdapter(BetweenSummary)


def read_between(folder: Path, number: int) -> BetweenSummary | None:
    """What was found between a frame and the next; None where the frames have changed since, or nothing is there."""
    path = folder / BETWEEN / f"{number:04d}.json"
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        ends = [frame_folder(folder, k) / VERTICES for k in (number, number + 1)]
        if record.pop("key") != between_key(*ends):
            return None
        return _SUMMARY.validate_python(record)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None


def _vertices(path: Path) -> Points:
    return np.load(path, allow_pickle=False)  # type: ignore[no-any-return]
