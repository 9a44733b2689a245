"""Turns the report of a sequence into one self-contained page; measures and judges nothing."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from musclefit.report.curves import curves
from musclefit.report.html import render_page, scene_parts, sentence, story_of
from musclefit.report.scene import Scene
from musclefit.report.sequence import MADE, SEQUENCE_SCHEMA_VERSION, FrameSummary, SequenceReport
from musclefit.validate.close_meetings import MeetingKind
from musclefit.validate.muscles import MuscleMeasures


@dataclass(frozen=True, slots=True)
class _Curve:
    title: str
    unit: str
    value: Callable[[MuscleMeasures], float | None]
    relative: bool


_CURVES = (
    _Curve("Volume", "change, %", lambda m: m.volume_mm3, True),
    _Curve("Length of the centreline", "change, %", lambda m: m.centreline_mm, True),
    _Curve("Largest cross-section", "change, %", lambda m: m.largest_section_mm2, True),
    _Curve("Surface area", "change, %", lambda m: m.surface_mm2, True),
    _Curve("Smallest gap to a neighbour", "mm", lambda m: m.gap_mm, False),
)


def render_sequence(
    report: SequenceReport,
    *,
    pictures: Mapping[str, tuple[str, bytes]],
    problems: str = "",
    scene: Scene | None = None,
) -> str:
    """One page that needs no other file and no network.

    Parameters
    ----------
    report : SequenceReport
    pictures : mapping of caption to (media type, bytes)
        Shown in order, the first at the head of the page.
    problems : str
        Why there are fewer pictures than there might be.
    scene : Scene or None
        The motion in 3-D; None leaves it out.
    """
    failed = [check for check in report.checks if not check.passed]
    drawn = {
        caption: f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
        for caption, (kind, data) in pictures.items()
    }
    page: dict[str, Any] = {
        "report": report,
        "verdict": report.verdict,
        "checks": report.checks,
        "failed": failed,
        "sentences": [sentence(check) for check in failed],
        "remark": "",
        "schema_version": SEQUENCE_SCHEMA_VERSION,
        "rows": [_row(frame) for frame in report.frames],
        "coordinates": list(report.frames[0].pose_deg),
        "passages": [(b, p) for b in report.between for p in b.passages],
        "failing": [kind.value for kind in MeetingKind if kind.fails],
        "unexamined": [b for b in report.between if b.problem],
        "curves": muscle_curves(report),
        "angles": Markup(_angles(report)),
        "story": story_of(report.checks, {}),
        "first_picture": dict(list(drawn.items())[:1]),
        "pictures": dict(list(drawn.items())[1:]),
        "problems": problems,
        "scene": scene_parts(scene),
    }
    return render_page("sequence.html.jinja", page)


def muscle_curves(report: SequenceReport) -> dict[str, Markup]:
    """The muscle measures over time as SVG by title; changes are against the first frame."""
    made = report.made
    if len(made) < 2:
        return {}
    names = [muscle.name for muscle in made[0].muscles]
    times = [frame.time_s for frame in made]
    drawn = {}
    for curve in _CURVES:
        lines = {}
        for number, name in enumerate(names):
            values = [curve.value(frame.muscles[number]) for frame in made]
            lines[name.removeprefix("muscle_")] = _relative(values) if curve.relative else values
        drawn[curve.title] = Markup(curves(times, lines, unit=curve.unit))
    return drawn


def _relative(values: list[float | None]) -> list[float | None]:
    first = values[0]
    return [None if v is None or not first else 100.0 * (v / first - 1.0) for v in values]


def _angles(report: SequenceReport) -> str:
    times = [frame.time_s for frame in report.frames]
    names = report.frames[0].pose_deg
    return curves(times, {name: [frame.pose_deg[name] for frame in report.frames] for name in names}, unit="degrees")


def _row(frame: FrameSummary) -> dict[str, Any]:
    said = {check.name: check for check in frame.checks}
    return {
        "frame": frame,
        "made": frame.outcome == MADE,
        "landmarks": said.get("landmark error"),
        "bones": said.get("bone off rigid"),
        "muscles": said.get("muscle volume change"),
        "overlap": said.get("introduced overlap"),
        "failed": [check.name for check in frame.checks if not check.passed],
    }
