"""A motion on disk: makes what is missing in worker processes, writes report, tables and series, reads frames back."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

from musclefit._version import __version__
from musclefit.errors import InputError
from musclefit.io.atomic import write_atomically
from musclefit.io.folder_locks import held
from musclefit.io.formats.rows import csv_text
from musclefit.io.formats.vtk_series import collection
from musclefit.io.provenance import versions
from musclefit.io.rig_names import RigGiven
from musclefit.io.rigs import read_rig
from musclefit.io.sequence_frames import (
    PLAN,
    SURFACES,
    StoredFrame,
    clear_partial,
    frame_key,
    read_frame,
    tissues_in_order,
    write_rest,
)
from musclefit.pipeline.deformers import least_steps
from musclefit.pipeline.retarget import settings_of
from musclefit.pipeline.sequence import posed_job
from musclefit.progress import Progress, Silent
from musclefit.report.sequence import (
    MADE,
    BetweenSummary,
    FrameSummary,
    SequenceReport,
    measures_table,
    sequence_to_json,
)
from musclefit.rig.job import Job
from musclefit.rig.motion import Interpolation, Pose
from musclefit.rig.transforms import BoneTransforms
from musclefit.workflows.given import word
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Judged
from musclefit.workflows.sequence_frames import FrameOnDisk, read_frames, read_plan
from musclefit.workflows.sequence_plan import SequencePlan, planned, with_motion
from musclefit.workflows.sequence_tasks import examine, make, prepare, read_between
from musclefit.workflows.worker_pool import Pool

SERIES, MEASURES, REPORT_JSON = "sequence.pvd", "muscles.csv", "report.json"


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class FollowedMotion(Judged):
    """A motion that was followed: the report, and the folder that holds its frames."""

    plan: SequencePlan
    report: SequenceReport
    folder: Path

    def frames(self) -> Iterator[FrameOnDisk]:
        """The frames in order of time, read back."""
        return read_frames(self.plan.job, self.folder)

    def said(self) -> str:
        """Verdict and frames in a line."""
        made, all_ = len(self.report.made), len(self.report.frames)
        return f"{self.report.title}: {self.report.verdict}; {made} of {all_} frames made; in {self.folder}"

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Checks, frames, and the measures of the muscles."""
        heading, *rows = measures_table(self.report.made)
        frames = [
            {"number": f.number, "time_s": f.time_s, "outcome": f.outcome, "problem": f.problem, **f.pose_deg}
            for f in self.report.frames
        ]
        muscles = [dict(zip(heading, row, strict=True)) for row in rows]
        return {"checks": self.report.checks, "frames": frames, "muscles": muscles}


def sequence(
    rig: RigGiven,
    motion: str | Path | None = None,
    *,
    out: str | Path,
    frames: int = 0,
    interpolation: Interpolation | str | None = None,
    workers: int = 0,
    overrides: Sequence[str] = (),
    between: bool = True,
    pictures: bool = True,
    progress: Progress | None = None,
) -> FollowedMotion:
    """Follow a motion: every frame from rest, checked; muscle measures, series, film and report.

    Parameters
    ----------
    rig : str, path or mapping
        Driven by joints or transforms; see `musclefit.run`.
    motion : path, optional
        CSV of joints' keyframes: time_s, <coordinate>_deg, ...; or, where an OpenSim model drives, .mot, .sto, .trc or
        .c3d; without it the rig's drive.motion.
    out : path
        Folder for the frames; a run that was interrupted there goes on.
    frames : int
        How many, evenly spaced in time; 0 for what the rig says.
    interpolation : {"cubic", "linear"}, optional
        Between keyframes; without it what the rig says.
    workers : int
        Processes, one thread each; 0 for this process alone. A script that asks for more must start its work inside of
        ``if __name__ == "__main__":``.
    overrides : sequence of str
        ``key=value`` each.
    between : bool
        Whether to examine what passes between frames.
    pictures : bool
        Whether to draw the frames.
    progress : Progress, optional

    Returns
    -------
    FollowedMotion
        The report; ``frames()`` reads the frames back from the folder.

    Raises
    ------
    RigError, LandmarkError, MeshError, InputError
        Input that cannot be used, or a folder that holds something else.
    """
    from musclefit.workflows.sequence_outputs import write_outputs  # brings VTK

    by = None if interpolation is None else word(Interpolation, interpolation, what="interpolation")
    with watched(progress) as stages:
        job = read_rig(rig, overrides=with_motion(motion, overrides), progress=stages)
        plan = planned(job, motion=motion, frames=frames, interpolation=by)
        report = run_sequence(plan, out, workers=workers, between=between, progress=stages)
        write_outputs(plan, Path(out), report, pictures=pictures, progress=stages)
    return FollowedMotion(plan, report, Path(out))


def run_sequence(
    plan: SequencePlan, folder: str | Path, *, workers: int = 0, between: bool = True, progress: Progress | None = None
) -> SequenceReport:
    """Make the frames of a motion that a folder does not hold yet, then report on all of them.

    Each frame is made from rest alone, in one of ``workers`` processes with one thread each (or in this one), and
    written whole or not at all. Run again after an interruption, frames that are there are verified by hash and kept;
    one that was changed, or made with other settings, is made again.

    Parameters
    ----------
    plan : SequencePlan
    folder : path
        New, empty, or of the same sequence.
    workers : int
        0 for this process. A script that asks for more must start its work inside of ``if __name__ == "__main__":``.
    between : bool
        Whether to examine what lies between frames.

    Returns
    -------
    SequenceReport
        Also as ``report.json``, with ``muscles.csv``, ``sequence.pvd`` and ``rest.vtp`` beside it.

    Raises
    ------
    InputError
        The folder holds something else or another sequence, or what `SequencePlan.poses` refuses.
    OSError
        A frame was not written whole, as on a full disk.
    """
    folder, progress, poses = Path(folder), progress or Silent(), plan.poses
    if workers < 0:
        raise InputError(f"found {workers} workers; expected at least 1, or 0 for this process")
    with held(folder):
        _claim(folder, plan)
        clear_partial(folder)
        keys = [frame_key(plan.job, pose) for pose in poses]
        missing = [p.number for p in poses if isinstance(read_frame(folder, p.number, key=keys[p.number]), str)]
        cpu_s = {"frames": 0.0, "between frames": 0.0}
        steps = [least_steps(posed_job(plan.job, pose)) for pose in poses]
        missing = longest_first(missing, steps)
        with Pool(workers, prepare=prepare, given=(plan.job, poses, folder.resolve())) as pool:
            cpu_s["frames"] = _run(pool, make, missing, "frames", progress, done=len(poses) - len(missing))
            stored = [_require(read_frame(folder, p.number, key=keys[p.number]), p) for p in poses]
            if between:
                asked = [k for k in range(len(poses) - 1) if all(stored[j].vertices_sha256 for j in (k, k + 1))]
                todo = [k for k in asked if (read := read_between(folder, k)) is None or read.problem]
                todo = longest_first(todo, steps)
                cpu_s["between frames"] = _run(
                    pool, examine, todo, "between frames", progress, done=len(asked) - len(todo)
                )
        summaries = tuple(frame.summary for frame in stored)
        report = SequenceReport(
            title=plan.job.rig.title,
            resampling=plan.resampling,
            frames=summaries,
            between=_between(folder, summaries) if between else (),
            limits={k: None if v is None else float(v) for k, v in plan.job.rig.limits.numbers.items()},
            cpu_s={name: round(seconds, 2) for name, seconds in cpu_s.items()},
            findings=plan.job.findings,
            provenance={
                "versions": versions(),
                "input_sha256": dict(plan.job.hashes),
                "settings": _plain(settings_of(plan.job)),
                "motion": plan.motion.source,
                "workers": workers,
            },
        )
        _write_tables(folder, report, stored)
        write_rest(folder, plan.job.anatomy)
    return report


def longest_first(numbers: Sequence[int], steps: Sequence[int]) -> list[int]:
    """Tasks in the order that keeps workers from waiting for the last: by the steps of their frames' marches, falling.

    Parameters
    ----------
    numbers : sequence of int
        Of frames.
    steps : sequence of int
        Of each frame of the sequence, at least.
    """
    return sorted(numbers, key=lambda number: -steps[number])


def _run(
    pool: Pool, task: Callable[[int], float], numbers: Sequence[int], title: str, progress: Progress, *, done: int
) -> float:
    """Run a task for each number, ticking; the CPU seconds of all."""
    total, seconds = done + len(numbers), 0.0
    with progress.stage(title) as tick:
        tick(done / max(total, 1))
        for _, took in pool.run(task, numbers):
            done, seconds = done + 1, seconds + took
            tick(done / total)
    return seconds


def _between(folder: Path, frames: Sequence[FrameSummary]) -> tuple[BetweenSummary, ...]:
    found = []
    for first, second in pairwise(frames):
        gone = [frame for frame in (first, second) if frame.outcome != MADE]
        if gone:
            problem = f"frame {gone[0].number} was {gone[0].outcome}"
            found.append(BetweenSummary(first.number, second.number, problem=problem))
        else:
            read = read_between(folder, first.number)
            found.append(read or BetweenSummary(first.number, second.number, problem="not written whole"))
    return tuple(found)


def _require(frame: StoredFrame | str, pose: Pose) -> StoredFrame:
    if isinstance(frame, str):
        raise OSError(f"frame {pose.number} was not written whole ({frame}); is the disk full?")
    return frame


def _claim(folder: Path, plan: SequencePlan) -> None:
    """Make the folder this sequence's, or raise InputError where it is something else's."""
    settings = json.loads(json.dumps(_plain(settings_of(plan.job)), default=str))
    ours = {
        "musclefit": __version__,
        "rig": plan.job.source,
        "motion": plan.motion.source,
        "motion_sha256": plan.motion.digest(),
        "interpolation": "screw" if isinstance(plan.motion, BoneTransforms) else plan.interpolation.value,
        "frames": len(plan.poses),
        "settings": settings,
        "inputs": dict(plan.job.hashes),
        "tissues": tissues_in_order(plan.job.anatomy),
    }
    if folder.is_dir() and any(folder.iterdir()):
        known = read_plan(folder)
        changed = [key for key in ("interpolation", "frames", "motion_sha256") if known.get(key) != ours[key]]
        former = str(known.get("rig", plan.job.source))
        if not _is_rig(plan.job, former, known.get("inputs")):
            raise InputError(
                f"{folder} holds a sequence of another rig ({former}, here {plan.job.source}); name another folder, or "
                "remove it"
            )
        if changed:
            raise InputError(
                f"{folder} holds another sequence (differing: {', '.join(changed)}); name another folder, or remove it"
            )
    elif folder.exists() and not folder.is_dir():
        raise InputError(f"the output folder {folder} is a file; name a folder that does not exist yet")
    write_atomically(folder / PLAN, json.dumps(ours, indent=1))


def _is_rig(job: Job, former: str, hashes: object) -> bool:
    """Whether a job's rig is the file that was named before, whatever it holds now, or a copy of what that held."""
    own = Path(job.source)
    if own.resolve() == Path(former).resolve():
        return True
    return isinstance(hashes, Mapping) and own.name in hashes and hashes[own.name] == job.hashes.get(own.name)


def _write_tables(folder: Path, report: SequenceReport, stored: Sequence[StoredFrame]) -> None:
    write_atomically(
        folder / SERIES,
        collection(
            [
                (frame.summary.time_s, PurePosixPath(frame.folder.relative_to(folder).as_posix()) / SURFACES)
                for frame in stored
                if frame.vertices_sha256
            ]
        ),
    )
    write_atomically(folder / MEASURES, csv_text(measures_table(report.made)))
    write_atomically(folder / REPORT_JSON, json.dumps(sequence_to_json(report), indent=1, allow_nan=False, default=str))


def _plain(value: Any) -> Any:
    """Settings as JSON values."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
