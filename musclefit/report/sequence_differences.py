"""Finished sequences side by side: each told by its worst frames, then held against the others as runs are."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from musclefit.report.run_differences import (
    Differences,
    FrameRow,
    MeasureRow,
    Values,
    better_of,
    measure_rows,
    notes_on,
    pair_rows,
    setting_rows,
    tissue_rows,
)

SAME_TIME_S = 1e-6
"""Frames whose times differ by less are of the same time."""


@dataclass(frozen=True, eq=False, slots=True)
class ToldFrame:
    """A frame of a sequence.

    Parameters
    ----------
    time_s : float
    outcome : str
        "made", "refused" or "failed".
    claim : str
        What is known of its map.
    result : mapping or None
        What was measured, as the report of a run holds it; None where it was not made.
    """

    time_s: float
    outcome: str
    claim: str
    result: Mapping[str, Any] | None


@dataclass(frozen=True, eq=False, slots=True)
class ToldSequence:
    """A sequence: report.json, and its frames in order of time."""

    report: Mapping[str, Any]
    frames: tuple[ToldFrame, ...]

    @property
    def results(self) -> list[Mapping[str, Any]]:
        """What was measured in the frames that were made."""
        return [frame.result for frame in self.frames if frame.result is not None]

    @property
    def certified(self) -> int:
        """Frames whose map is proved one-to-one."""
        return sum(frame.result is not None and frame.claim == "certified" for frame in self.frames)


def sequence_differences(
    sequences: Mapping[str, ToldSequence],
    *,
    apart_mm: Mapping[str, Values],
    frames_apart_mm: Mapping[float, Values],
) -> Differences:
    """Put sequences side by side: each tissue and pair by its worst frame, and every frame by its time.

    Parameters
    ----------
    sequences : mapping of name to sequence
        At least two.
    apart_mm : mapping of tissue to values
        How far each sequence's tissue lies at most from the first sequence's, over frames of the same time.
    frames_apart_mm : mapping of time in s to values
        The same of all tissues at each time, by the times of `times_of`.
    """
    names = tuple(sequences)
    told = tuple(_as_one(one) for one in sequences.values())
    share = [-one.certified / max(len(one.frames), 1) for one in sequences.values()]
    best, because = better_of(names, told, (("more of its frames are certified", share),))
    return Differences(
        runs=names,
        titles=tuple(str(one["title"]) for one in told),
        verdicts=tuple(str(one["verdict"]) for one in told),
        claims=tuple(f"{s.certified} of {len(s.frames)} frames certified" for s in sequences.values()),
        mesh_claims=("none",) * len(told),
        best=best,
        because=because,
        settings=setting_rows(told),
        measures=(*measure_rows(told), *_unjudged(tuple(sequences.values()))),
        tissues=tissue_rows(told, apart_mm),
        pairs=pair_rows(told),
        notes=(*notes_on(names, told), *_notes_on_times(names, tuple(sequences.values()))),
        frames=_frame_rows(tuple(sequences.values()), frames_apart_mm),
    )


def times_of(sequences: Sequence[ToldSequence]) -> list[float]:
    """The times of all frames, s, rising; those that are the same once, by the first sequence that has them."""
    times: list[float] = []
    for one in sequences:
        times += [f.time_s for f in one.frames if not any(abs(f.time_s - t) < SAME_TIME_S for t in times)]
    return sorted(times)


def frame_at(sequence: ToldSequence, time_s: float) -> ToldFrame | None:
    """The frame of a sequence at a time."""
    return next((frame for frame in sequence.frames if abs(frame.time_s - time_s) < SAME_TIME_S), None)


def _as_one(sequence: ToldSequence) -> dict[str, Any]:
    """A sequence in the form of a run: every tissue and every pair as in the frame in which it is worst."""
    tissues: dict[str, dict[str, Any]] = {}
    pairs: dict[tuple[str, str], dict[str, Any]] = {}
    unchecked: dict[str, dict[str, Any]] = {}
    for result in sequence.results:
        for tissue in result["tissues"]:
            known = tissues.setdefault(tissue["name"], dict(tissue))
            for key in ("volume_change_percent", "rigidity_mm", "outside_skin_introduced_mm3"):
                known[key] = _worse(known[key], tissue[key])
        for pair in result["overlaps"]:
            name = (str(pair["a"]), str(pair["b"]))
            shared = pairs.setdefault(name, dict(pair))
            for key in ("deformed_mm3", "introduced_mm3"):
                shared[key] = _worse(shared[key], pair[key])
        unchecked |= {str(left["what"]): left for left in result["not_checked"]}
    return {
        **sequence.report,
        "tissues": list(tissues.values()),
        "overlaps": list(pairs.values()),
        "not_checked": list(unchecked.values()),
    }


def _worse(a: float | None, b: float | None) -> float | None:
    """The one of the larger size; None, which is not measured, is worse than any."""
    return None if a is None or b is None else max(a, b, key=abs)


def _unjudged(sequences: tuple[ToldSequence, ...]) -> tuple[MeasureRow, ...]:
    """What no limit is set to."""

    def row(name: str, unit: str, value: Callable[[ToldSequence], float | None]) -> MeasureRow:
        return MeasureRow(name, unit, tuple(value(s) for s in sequences), (None,) * len(sequences), ())

    return (
        row("frames made", "", lambda s: float(len(s.results))),
        row("frames certified", "", lambda s: float(s.certified)),
        row("pairs of frames proved free of meetings", "", lambda s: s.report.get("proved_free_between")),
        row("CPU of all frames", "s", _cpu_s),
    )


def _cpu_s(sequence: ToldSequence) -> float:
    return math.fsum(frame["cpu_s"].get("frame", 0.0) for frame in sequence.report["frames"])


def _frame_rows(sequences: tuple[ToldSequence, ...], apart_mm: Mapping[float, Values]) -> tuple[FrameRow, ...]:
    rows = []
    for time_s in times_of(sequences):
        there = [frame_at(one, time_s) for one in sequences]
        results = [None if frame is None else frame.result for frame in there]
        rows.append(
            FrameRow(
                time_s=time_s,
                outcomes=tuple("" if frame is None else frame.outcome for frame in there),
                muscle_change_percent=tuple(None if r is None else _largest_change(r) for r in results),
                introduced_mm3=tuple(None if r is None else _introduced(r) for r in results),
                apart_mm=apart_mm.get(time_s, (None,) * len(sequences)),
            )
        )
    return tuple(rows)


def _largest_change(result: Mapping[str, Any]) -> float | None:
    changes = [tissue["volume_change_percent"] for tissue in result["tissues"] if tissue["kind"] == "muscle"]
    return None if not changes or None in changes else max(map(abs, changes))


def _introduced(result: Mapping[str, Any]) -> float | None:
    volumes = [pair["introduced_mm3"] for pair in result["overlaps"]]
    return None if None in volumes else math.fsum(volumes)


def _notes_on_times(names: tuple[str, ...], sequences: tuple[ToldSequence, ...]) -> list[str]:
    notes = []
    first = sequences[0]
    for name, other in zip(names[1:], sequences[1:], strict=True):
        common = sum(frame_at(other, frame.time_s) is not None for frame in first.frames)
        if common < max(len(first.frames), len(other.frames)):
            notes.append(
                f"{names[0]} has {len(first.frames)} frames and {name} {len(other.frames)}, {common} of them at the "
                "same times: how far apart they are is told of those"
            )
    return notes
