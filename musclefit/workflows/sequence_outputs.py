"""What people look at: page, film and animated model of a sequence; measures nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.figures.colours import tissue_colours
from musclefit.figures.films import contact_sheet, film_pace, gif, motion_pictures, mp4, mp4_problem
from musclefit.figures.rendering import rendering_problem
from musclefit.figures.scenes import motion_scene
from musclefit.io.atomic import write_atomically, write_bytes_atomically
from musclefit.io.formats.glb import animated_glb
from musclefit.progress import Progress, Silent
from musclefit.report.sequence import FrameSummary, SequenceReport
from musclefit.report.sequence_html import render_sequence
from musclefit.workflows.sequence_frames import read_frames
from musclefit.workflows.sequence_plan import SequencePlan

PAGE, FILM_GIF, FILM_MP4, MODEL = "report.html", "motion.gif", "motion.mp4", "motion.glb"

SHEET_FRAMES = 12
"""Frames shown beside each other on the page."""


def write_outputs(
    plan: SequencePlan, folder: Path, report: SequenceReport, *, pictures: bool = True, progress: Progress | None = None
) -> tuple[Path, ...]:
    """Write page, film (MP4 where that can be made, else GIF) and animated model of a sequence into its folder.

    Parameters
    ----------
    plan : SequencePlan
    folder : Path
        Of `run_sequence`.
    report : SequenceReport
        Of `run_sequence`.
    pictures : bool
        Whether to draw the frames: about a second each.

    Returns
    -------
    tuple of Path
    """
    progress = progress or Silent()
    kept = [(f.summary, f.anatomy()) for f in read_frames(plan.job, folder) if f.summary.outcome == "made"]
    written: list[Path] = []
    embedded: dict[str, tuple[str, bytes]] = {}
    problems = "" if kept else "No frame was made."
    if kept:
        written.append(_write_model(folder, kept, progress))
    if kept and pictures:
        problems = rendering_problem()
        if not problems:
            drawn = _draw(kept, progress)
            seconds_each, slower = film_pace([summary.time_s for summary, _ in kept])
            data = gif(drawn, seconds_each=seconds_each)
            written.append(write_bytes_atomically(folder / FILM_GIF, data))
            problems = mp4_problem()
            if not problems:
                written.append(write_bytes_atomically(folder / FILM_MP4, mp4(drawn, seconds_each=seconds_each)))
            sheet = [drawn[k] for k in _even(len(drawn), SHEET_FRAMES)]
            columns = min(len(sheet), 6)
            embedded["Frames in order of time"] = ("image/png", contact_sheet(sheet, columns=columns, width_px=260))
            embedded[f"The motion{slower}"] = ("image/gif", data)
    frames = [(_title(summary).replace("\n", ", "), summary.time_s, anatomy) for summary, anatomy in kept]
    scene = motion_scene(plan.job.anatomy, frames) if kept else None
    page = render_sequence(report, pictures=embedded, problems=problems, scene=scene)
    write_atomically(folder / PAGE, page)
    return (folder / PAGE, *written)


def _write_model(folder: Path, kept: list[tuple[FrameSummary, Anatomy]], progress: Progress) -> Path:
    with progress.stage("animated model"):
        frames, times = [anatomy for _, anatomy in kept], [summary.time_s for summary, _ in kept]
        return write_bytes_atomically(folder / MODEL, animated_glb(frames, times, colours=tissue_colours(frames[0])))


def _draw(kept: list[tuple[FrameSummary, Anatomy]], progress: Progress) -> list[bytes]:
    titles = [_title(summary) for summary, _ in kept]
    drawn = []
    with progress.stage("film") as tick:
        for picture in motion_pictures([anatomy for _, anatomy in kept], titles):
            drawn.append(picture)
            tick(len(drawn) / len(kept))
    return drawn


def _title(summary: FrameSummary) -> str:
    pose = ", ".join(f"{name} {angle:.0f}°" for name, angle in summary.pose_deg.items())
    return f"{summary.time_s:.2f} s\n{pose}"


def _even(count: int, wanted: int) -> list[int]:
    return sorted({round(k) for k in np.linspace(0, count - 1, min(count, wanted)).tolist()})
