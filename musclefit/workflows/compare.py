"""Finished runs, or sequences, side by side: read back, held against the first, and written as a page."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError
from musclefit.figures.scenes import compared_scene, motions_scene
from musclefit.io.finished_runs import FinishedRun, read_finished_run
from musclefit.io.finished_sequences import FinishedSequence, is_sequence, read_finished_sequence
from musclefit.io.run_folder import require_new_folder, write_new_folder
from musclefit.report.html import render_differences
from musclefit.report.run_differences import Differences, Values, differences
from musclefit.report.scene import Scene
from musclefit.report.sequence_differences import (
    ToldFrame,
    ToldSequence,
    frame_at,
    sequence_differences,
    times_of,
)
from musclefit.workflows.results import Shown

COMPARISON_HTML, COMPARISON_JSON = "comparison.html", "comparison.json"


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class Comparison(Shown):
    """Runs, or sequences, side by side.

    Parameters
    ----------
    found : Differences
    folder : Path or None
        Where it was written.
    """

    found: Differences
    folder: Path | None = None

    def said(self) -> str:
        """Which run is better, and why, in a line."""
        found = self.found
        head = "no run is better" if found.best is None else f"{found.runs[found.best]} is better"
        return f"{', '.join(found.runs)}: {head}: {found.because}"

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Settings that differ, measures, tissues, overlapping pairs, and of sequences the frames."""
        found = self.found
        return {
            "settings": found.settings,
            "measures": found.measures,
            "tissues": found.tissues,
            "overlaps": found.pairs,
            **({"frames": found.frames} if found.frames else {}),
        }


def compare(runs: Sequence[str | Path], *, out: str | Path | None = None) -> Comparison:
    """Compare finished runs: the settings and results that differ, and which run is better.

    Sequences are compared with sequences: by their worst frames, and frame by frame at the same times.

    Parameters
    ----------
    runs : sequence of path
        Two folders or more that `musclefit run` wrote, or `musclefit sequence`; the others are held against the first.
    out : path, optional
        New folder for comparison.html and comparison.json.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError, MeshError
        Fewer than two runs, a folder that holds none, runs and sequences together, or an output folder that is not
        empty.
    """
    if len(runs) < 2:
        raise InputError(f"found {len(runs)} run to compare; expected at least 2")
    if out is not None:
        require_new_folder(Path(out))
    kinds = [is_sequence(run) for run in runs]
    if any(kinds) and not all(kinds):
        raise InputError(
            f"{runs[kinds.index(True)]} is a sequence and {runs[kinds.index(False)]} is none; compare runs with runs, "
            "and sequences with sequences"
        )
    found, scene, folders = _sequences(runs) if all(kinds) else _runs(runs)
    if out is None:
        return Comparison(found)
    folder = Path(out)
    page = render_differences(found, links=_links(folders, folder), scene=scene())
    text = json.dumps(found.to_json(), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    write_new_folder(
        folder,
        {
            COMPARISON_HTML: page.encode("utf-8", "backslashreplace"),
            COMPARISON_JSON: text.encode("utf-8", "backslashreplace"),
        },
    )
    return Comparison(found, folder)


def distinct_names(folders: Sequence[Path]) -> list[str]:
    """The shortest ends of paths that tell folders apart; a folder given twice has a number behind.

    >>> distinct_names([Path("/a/left/out"), Path("/a/right/out")])
    ['left/out', 'right/out']
    """
    whole = [folder.resolve().parts for folder in folders]
    for count in range(1, max(map(len, whole)) + 1):
        names = ["/".join(parts[-count:]) for parts in whole]
        if len(set(names)) == len(set(whole)):
            break
    return [name if names.count(name) == 1 else f"{name} ({k + 1})" for k, name in enumerate(names)]


def distances_from_first(shapes: Sequence[tuple[Anatomy, Anatomy]]) -> dict[str, Values]:
    """How far each tissue of each run lies at most from where the first run takes it, mm, by tissue.

    Compared are the vertices that both have from the start: refined surfaces keep the given ones first. None where
    a run lacks the tissue, or has another one under its name.

    Parameters
    ----------
    shapes : sequence of (rest, deformed)
    """
    rests = [{tissue.name: tissue.surface.vertices for tissue in rest} for rest, _ in shapes]
    moved = [{tissue.name: tissue.surface.vertices for tissue in deformed} for _, deformed in shapes]
    return {
        name: tuple(
            _farthest(rests[0][name], moved[0][name], rests[k][name], moved[k][name]) if name in rests[k] else None
            for k in range(len(shapes))
        )
        for name in rests[0]
    }


def _farthest(rest: Any, moved: Any, other_rest: Any, other_moved: Any) -> float | None:
    both = min(len(rest), len(other_rest))
    same = np.all(rest[:both] == other_rest[:both], axis=1)
    count = both if same.all() else int(np.argmin(same))
    if not count:
        return None
    return float(np.linalg.norm(moved[:count] - other_moved[:count], axis=1).max())


def _runs(runs: Sequence[str | Path]) -> tuple[Differences, Callable[[], Scene | None], list[Path]]:
    """What runs differ in, how they look in 3-D, and their folders."""
    read: list[FinishedRun] = [read_finished_run(run) for run in runs]
    names = distinct_names([run.folder for run in read])
    shapes = [run.surfaces() for run in read]
    found = differences(
        {name: run.report for name, run in zip(names, read, strict=True)}, apart_mm=distances_from_first(shapes)
    )
    return found, lambda: _scene(names, shapes), [run.folder for run in read]


def _sequences(runs: Sequence[str | Path]) -> tuple[Differences, Callable[[], Scene | None], list[Path]]:
    """What sequences differ in, how they look in 3-D, and their folders."""
    read = [read_finished_sequence(run) for run in runs]
    names = distinct_names([one.folder for one in read])
    told = [_told(one) for one in read]
    by_tissue: dict[str, list[Values]] = {}
    by_time: dict[float, Values] = {}
    for time_s in times_of(told):
        there = [_anatomy_at(one, own, time_s) for one, own in zip(read, told, strict=True)]
        if there[0] is None:
            continue
        apart = _apart(read, there)
        for name, values in apart.items():
            by_tissue.setdefault(name, []).append(values)
        by_time[time_s] = _largest(list(apart.values()))
    found = sequence_differences(
        dict(zip(names, told, strict=True)),
        apart_mm={name: _largest(values) for name, values in by_tissue.items()},
        frames_apart_mm=by_time,
    )
    return found, lambda: _motions(names, read), [one.folder for one in read]


def _told(sequence: FinishedSequence) -> ToldSequence:
    frames = [
        ToldFrame(frame.summary.time_s, frame.summary.outcome, frame.summary.claim, frame.result)
        for frame in sequence.frames
    ]
    return ToldSequence(sequence.report, tuple(frames))


def _anatomy_at(sequence: FinishedSequence, told: ToldSequence, time_s: float) -> Anatomy | None:
    """The given triangles of a sequence at a time; None where it has no frame then."""
    found = frame_at(told, time_s)
    if found is None or found.result is None:
        return None
    return sequence.anatomy(sequence.frames[told.frames.index(found)])


def _apart(sequences: Sequence[FinishedSequence], there: Sequence[Anatomy | None]) -> dict[str, Values]:
    """How far each tissue lies at most from where the first sequence takes it at one time, mm, by tissue."""
    first = there[0]
    assert first is not None
    own = [k for k, anatomy in enumerate(there) if anatomy is not None]
    found = distances_from_first([(sequences[k].rest, anatomy) for k in own if (anatomy := there[k]) is not None])
    return {
        name: tuple(values[own.index(k)] if k in own else None for k in range(len(there)))
        for name, values in found.items()
    }


def _largest(rows: Sequence[Values]) -> Values:
    """The largest of each column; None where none is known."""
    return tuple(
        max((value for value in column if value is not None), default=None) for column in zip(*rows, strict=True)
    )


def _motions(names: Sequence[str], sequences: Sequence[FinishedSequence]) -> Scene | None:
    """The motions in 3-D; None where they have other tissues, or none has a frame."""
    tissues = [[tissue.name for tissue in one.rest] for one in sequences]
    if any(other != tissues[0] for other in tissues) or not all(one.made for one in sequences):
        return None
    motions = {
        name: [(f"{frame.summary.time_s:.3f} s", frame.summary.time_s, one.anatomy(frame)) for frame in one.made]
        for name, one in zip(names, sequences, strict=True)
    }
    return motions_scene(sequences[0].rest, motions)


def _scene(names: Sequence[str], shapes: Sequence[tuple[Anatomy, Anatomy]]) -> Scene | None:
    """The runs in 3-D; None where they have other tissues."""
    tissues = [[tissue.name for tissue in rest] for rest, _ in shapes]
    if any(other != tissues[0] for other in tissues):
        return None
    return compared_scene(shapes[0][0], dict(zip(names, (deformed for _, deformed in shapes), strict=True)))


def _links(folders: Sequence[Path], folder: Path) -> list[str]:
    """Where each run's own page is, from the folder of the comparison."""
    from os.path import relpath

    from musclefit.io.run_folder import REPORT_HTML

    pages = [own / REPORT_HTML for own in folders]
    return [Path(relpath(page, folder)).as_posix() if page.is_file() else "" for page in pages]
